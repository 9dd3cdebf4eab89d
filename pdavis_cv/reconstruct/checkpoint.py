"""Reading FireNet checkpoints, which are pickles, without trusting or torch.

A checkpoint is a zip of a pickle and of one file per tensor.  The pickle may name only
what a state dict is made of; those names stand for harmless things of our own, and
anything else is refused before it is looked at.
"""
from __future__ import annotations

import io
import math
import pickle
import pickletools
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.errors import WeightsError
from pdavis_cv.reconstruct.weights import Weights, expected_shapes

__all__ = ["firenet_weights", "read_state_dict"]

_MOST_BYTES = 1 << 24
"""Of the pickle, of one tensor and of a plain zip member; FireNet needs 0.5 MB."""

_DTYPES = {"FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2",
           "LongStorage": "<i8", "IntStorage": "<i4", "ShortStorage": "<i2",
           "CharStorage": "<i1", "ByteStorage": "<u1", "BoolStorage": "?"}

Array = NDArray[Any]


class _Tensor:
    """Stands for torch._utils._rebuild_tensor_v2; has no state to tamper with."""

    __slots__ = ()

    def __call__(
        self, storage: Array, offset: int, size: tuple[int, ...],
        stride: tuple[int, ...], *_: Any,
    ) -> Array:
        """Return a tensor's numbers."""
        # The numbers come from the file: none of them may reach beyond the storage.
        if len(size) != len(stride) or any(
                not isinstance(v, int) or v < 0 for v in (offset, *size, *stride)):
            raise ValueError(f"a tensor of size {size} and stride {stride}")
        if any(side == 0 for side in size):
            return np.zeros(0, storage.dtype)
        last = offset + sum((n - 1) * s for n, s in zip(size, stride, strict=True))
        if last >= len(storage) or math.prod(size) > len(storage):
            raise ValueError(
                f"a tensor of size {size} that ends at {last} of {len(storage)}")
        return np.lib.stride_tricks.as_strided(
            storage[offset:], size, [s * storage.itemsize for s in stride],
            writeable=False).copy()


class _Parameter:
    """Stands for torch._utils._rebuild_parameter."""

    __slots__ = ()

    def __call__(self, tensor: Array, *_: Any) -> Array:
        """Return the tensor."""
        return tensor


class _Reader(pickle.Unpickler):
    """Builds only what a state dict needs.

    Parameters
    ----------
    stream : binary file
    archive : ZipFile
    folder : str
        Where the tensors lie.
    path : str
        For messages.
    """

    def __init__(
        self, stream: IO[bytes], archive: zipfile.ZipFile, folder: str, path: str
    ) -> None:
        super().__init__(stream, encoding="utf-8")
        self._archive, self._folder, self._path = archive, folder, path

    def find_class(self, module: str, name: str) -> Any:
        """Return what stands for a global name, or refuse it."""
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _Tensor()
        if (module, name) == ("torch._utils", "_rebuild_parameter"):
            return _Parameter()
        if module == "torch" and name in _DTYPES:
            return name
        raise WeightsError(
            f"{self._path}: refused, its pickle asks for {module}.{name}, which no "
            "state dict needs")

    def persistent_load(self, pid: Any) -> Array:
        """Return the numbers of one tensor's file."""
        kind, storage, key, _, _ = pid
        if kind != "storage" or storage not in _DTYPES:
            raise ValueError(f"storage of {storage!r}")
        data = _member(self._archive, f"{self._folder}/data/{key}")
        dtype = np.dtype(_DTYPES[storage])
        return np.frombuffer(data[:len(data) // dtype.itemsize * dtype.itemsize], dtype)


def _scan(data: bytes) -> None:
    """Refuse a pickle whose memo would fill the memory."""
    for code, argument, _ in pickletools.genops(data):
        if "PUT" in code.name and int(argument or 0) > len(data):
            raise ValueError(f"memo {argument} in a pickle of {len(data)} bytes")


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    info = archive.getinfo(name)
    if info.file_size > _MOST_BYTES:
        raise ValueError(f"{name} of {info.file_size} bytes")
    return archive.read(info)


def read_state_dict(path: str | Path) -> Mapping[str, Array]:
    """Return the ``state_dict`` of a checkpoint by name.

    Parameters
    ----------
    path : path
        A file that ``torch.save`` wrote (zip format).

    Returns
    -------
    mapping of str to ndarray

    Raises
    ------
    WeightsError
        If the file is not such a checkpoint, is damaged, or its pickle asks for
        anything that a state dict does not need; nothing of it has been executed.
    OSError
        If it cannot be opened.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            pickles = [name for name in archive.namelist()
                       if name.endswith("/data.pkl")]
            if len(pickles) != 1:
                _refuse(path, "no data.pkl in it")
            folder = pickles[0].removesuffix("/data.pkl")
            data = _member(archive, pickles[0])
            _scan(data)
            found = _Reader(io.BytesIO(data), archive, folder, str(path)).load()
    except WeightsError:
        raise
    except zipfile.BadZipFile as error:
        _refuse(path, str(error))
    except OSError:
        raise
    except Exception as error:  # a pickle can go wrong in any way
        _refuse(path, f"{type(error).__name__}: {error}")
    state = found.get("state_dict", found) if isinstance(found, dict) else None
    if not isinstance(state, dict) or not state or not all(
            isinstance(name, str) and isinstance(value, np.ndarray)
            for name, value in state.items()):
        _refuse(path, "no state_dict of arrays in it")
    return state


def _refuse(path: str | Path, why: str) -> NoReturn:
    raise WeightsError(f"{path}: not a checkpoint that can be read ({why})") from None


def firenet_weights(path: str | Path) -> Weights:
    """Return the weights of a published FireNet checkpoint.

    Parameters
    ----------
    path : path

    Returns
    -------
    Weights
        Of network ``firenet``: takes counts of events, gives intensity.

    Raises
    ------
    WeightsError
        If `read_state_dict` refuses it, or it is of another network.
    """
    state = read_state_dict(path)
    ours: dict[str, Array] = {}
    used = set()

    def take(name: str) -> Array:
        if name not in state:
            raise WeightsError(f"{path}: not a FireNet, it has no {name!r}")
        used.add(name)
        return np.asarray(state[name], np.float32)

    for kind in ("weight", "bias"):
        ours[f"head.{kind}"] = take(f"net.head.conv.conv2d.{kind}")
        ours[f"pred.{kind}"] = take(f"net.pred.conv2d.{kind}")
        cells = ("net.head.recurrent_block", "net.resblocks.0.recurrent_block")
        for i, cell in enumerate(cells, 1):
            update, reset = (take(f"{cell}.{gate}_gate.{kind}")
                             for gate in ("update", "reset"))
            ours[f"g{i}.gates.{kind}"] = np.concatenate((update, reset))
            ours[f"g{i}.new.{kind}"] = take(f"{cell}.out_gate.{kind}")
        for i, block in enumerate(("net.resblocks.0.conv", "net.resblocks.1"), 1):
            for part, number in (("a", 1), ("b", 2)):
                ours[f"r{i}.{part}.{kind}"] = take(f"{block}.conv{number}.{kind}")
    more = sorted(state.keys() - used)
    if more:
        raise WeightsError(f"{path}: not a FireNet, it also has {more[0]!r}")
    for name, shape in expected_shapes("firenet").items():
        if ours[name].shape != shape:
            raise WeightsError(
                f"{path}: not this FireNet, {name} must have shape {shape}, got "
                f"{ours[name].shape}")
    return Weights("firenet", ours, None, {"from": Path(path).name})
