"""Read FireNet checkpoints, which are pickles, without executing them or using torch.

A checkpoint is a zip of a pickle and of one file per tensor, or, before torch 1.6, a
stream of pickles and numbers.  A pickle can import and call any function, so the names
in it are resolved here: those that a state dict consists of, to functions of this
module; classes of the program that trained the network, to `_Inert`; of the standard
library, numpy and torch only the names listed here.  Any other name is refused.
"""
from __future__ import annotations

import io
import math
import pickle
import pickletools
import sys
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.errors import WeightsError
from pdavis_cv.reconstruct.weights import Weights, expected_shapes

_MOST_BYTES = 1 << 24
"""Bound on the size of a zip member: the pickle or a tensor; FireNet needs 0.5 MB."""

_DTYPES = {"FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2",
           "LongStorage": "<i8", "IntStorage": "<i4", "ShortStorage": "<i2",
           "CharStorage": "<i1", "ByteStorage": "<u1", "BoolStorage": "?"}

_TENSORS = ("_rebuild_tensor", "_rebuild_tensor_v2")
_DATA = frozenset((
    ("_codecs", "encode"), ("collections", "defaultdict"), ("datetime", "datetime"),
    ("numpy", "dtype"), ("numpy.core.multiarray", "scalar"), ("pathlib", "PosixPath"),
    ("torch", "Size"), ("torch", "device")))
"""Names of data beside a state dict, such as the best loss, which are discarded."""

_LEGACY = pickle.dumps(0x1950A86A20F9469CFC6C, 2)
"""A checkpoint of torch before 1.6 begins with this number as a pickle."""
_LEGACY_PROTOCOL = 1001
_MOST_LEGACY_BYTES = 1 << 26
"""Bound on such a file; FireNet with the state of its optimiser has 0.5 MB."""

Array = NDArray[Any]


class _Tensor:
    """Replace torch._utils._rebuild_tensor_v2; no attribute of it can be set."""

    __slots__ = ()

    def __call__(
        self, storage: Array, offset: int, size: tuple[int, ...],
        stride: tuple[int, ...], *_: Any,
    ) -> Array:
        """Return the array of this size and stride (elements) in a storage."""
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
            storage[offset:], size, [s * storage.strides[0] for s in stride],
            writeable=False).copy()


class _Parameter:
    """Replace torch._utils._rebuild_parameter."""

    __slots__ = ()

    def __call__(self, tensor: Array, *_: Any) -> Array:
        """Return the tensor."""
        return tensor


class _Inert:
    """Replace a class whose objects are not needed: accept all data, keep none."""

    __slots__ = ()

    def __new__(cls, *_: Any, **__: Any) -> _Inert:
        return object.__new__(cls)

    def __setstate__(self, state: Any) -> None:
        """Discard the object's attributes."""

    def __setitem__(self, key: Any, value: Any) -> None:
        """Discard an item of a mapping."""

    def append(self, value: Any) -> None:
        """Discard an item of a list."""

    def extend(self, values: Any) -> None:
        """Discard items of a list."""


class _Unpickler(pickle.Unpickler):
    """Unpickle objects of the allowed names only.

    `storage` returns a storage's numbers, given its persistent id without the first
    part.
    """

    def __init__(self, data: bytes, storage: Callable[..., Array], path: str) -> None:
        for code, argument, _ in pickletools.genops(data):
            if "PUT" in code.name and int(argument or 0) > len(data):
                # its memo would fill the memory
                raise ValueError(f"memo {argument} in a pickle of {len(data)} bytes")
        super().__init__(io.BytesIO(data), encoding="utf-8")
        self._storage, self._path = storage, path

    def find_class(self, module: str, name: str) -> Any:
        """Resolve a global name, or raise WeightsError."""
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if module == "torch._utils" and name in _TENSORS:
            return _Tensor()
        if (module, name) == ("torch._utils", "_rebuild_parameter"):
            return _Parameter()
        if module == "torch" and name in _DTYPES:
            return name
        package = module.partition(".")[0]
        if (module, name) in _DATA or not (
                package in sys.stdlib_module_names or package in ("numpy", "torch")
                or package.startswith("_")):
            return _Inert
        raise WeightsError(
            f"{self._path}: refused, its pickle asks for {module}.{name}, which no "
            "state dict needs")

    def persistent_load(self, pid: Any) -> Any:
        """Return the numbers of a storage."""
        kind, *parts = pid
        if kind == "module":  # legacy: a class and its source text, which is not run
            return parts[0]
        if kind != "storage" or parts[0] not in _DTYPES:
            raise ValueError(f"storage of {parts[:1]!r}")
        return self._storage(*parts)


def _zipped(path: str | Path) -> Any:
    """Return the object in a checkpoint of torch 1.6 and later, a zip."""
    with zipfile.ZipFile(path) as archive:
        pickles = [name for name in archive.namelist() if name.endswith("/data.pkl")]
        if len(pickles) != 1:
            _refuse(path, "no data.pkl in it")
        folder = pickles[0].removesuffix("/data.pkl")

        def storage(kind: str, key: str, *_: Any) -> Array:
            data = _member(archive, f"{folder}/data/{key}")
            dtype = np.dtype(_DTYPES[kind])
            return np.frombuffer(
                data[:len(data) // dtype.itemsize * dtype.itemsize], dtype)

        return _Unpickler(_member(archive, pickles[0]), storage, str(path)).load()


def _legacy(path: str | Path, data: bytes) -> Any:
    """Return the object in a checkpoint of torch before 1.6, a stream.

    Five pickles (magic number, protocol version, properties of the machine, the object,
    the names of its storages), then each storage: its length, int64, and its numbers.
    """
    at = len(_LEGACY)
    parts = []
    for _ in range(4):
        end = at + _pickle_size(data[at:])
        parts.append(data[at:end])
        at = end
    version, machine, whole, names = parts

    def none(*_: Any) -> Array:
        raise ValueError("a storage before the object")

    protocol = _Unpickler(version, none, str(path)).load()
    if protocol != _LEGACY_PROTOCOL:
        raise ValueError(f"protocol {protocol!r}")
    facts = _Unpickler(machine, none, str(path)).load()
    if not isinstance(facts, dict) or facts.get("little_endian") is not True:
        raise ValueError("numbers are not little-endian")
    # The numbers follow the object, which states their types, so it is read twice.
    sizes: dict[str, tuple[np.dtype[Any], int]] = {}

    def noted(kind: str, key: str, place: str, count: int, *_: Any) -> Array:
        dtype = np.dtype(_DTYPES[kind])
        if not isinstance(count, int) or not 0 <= count * dtype.itemsize <= len(data):
            raise ValueError(f"storage {key} of {count!r} numbers")
        sizes[key] = dtype, count
        # Zeros of stride 0, which need no memory; shapes are checked this time too.
        return np.broadcast_to(np.zeros((), dtype), count)

    _Unpickler(whole, noted, str(path)).load()
    keys = _Unpickler(names, none, str(path)).load()
    if not isinstance(keys, list) or not set(sizes) <= set(keys):
        raise ValueError("storages without a name")
    storages: dict[str, Array] = {}
    for key in keys:
        dtype, count = sizes[key]
        stated = int.from_bytes(data[at:at + 8], "little", signed=True)
        at += 8
        if stated != count or at + count * dtype.itemsize > len(data):
            raise ValueError(f"storage {key} of {stated} numbers, {count} expected")
        storages[key] = np.frombuffer(data, dtype, count, at)
        at += count * dtype.itemsize

    def storage(kind: str, key: str, place: str, count: int, view: Any = None) -> Array:
        found = storages[key]
        if view is None:
            return found
        _, offset, length = view
        if not 0 <= offset <= offset + length <= len(found):
            raise ValueError(f"a view of {offset} .. {offset + length} of {len(found)}")
        return found[offset:offset + length]

    return _Unpickler(whole, storage, str(path)).load()


def _pickle_size(data: bytes) -> int:
    """Return the length in bytes of the pickle at the beginning of data."""
    for code, _, at in pickletools.genops(data[:_MOST_BYTES]):
        if code.name == "STOP":
            return int(at or 0) + 1
    raise ValueError("a pickle without an end")


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    info = archive.getinfo(name)
    if info.file_size > _MOST_BYTES:
        raise ValueError(f"{name} of {info.file_size} bytes")
    return archive.read(info)


def read_state_dict(path: str | Path) -> Mapping[str, Array]:
    """Return the ``state_dict`` of a checkpoint by name.

    The file was written by ``torch.save``, as a zip or as before torch 1.6.  A
    WeightsError says that it is not such a checkpoint, is damaged, or that its pickle
    asks for anything that a state dict does not need; nothing of it has been executed.
    """
    try:
        with Path(path).open("rb") as file:
            start = file.read(len(_LEGACY))
            legacy = start == _LEGACY
            if legacy and Path(path).stat().st_size > _MOST_LEGACY_BYTES:
                _refuse(path, f"more than {_MOST_LEGACY_BYTES >> 20} MiB")
            data = start + file.read() if legacy else b""
        found = _legacy(path, data) if legacy else _zipped(path)
    except WeightsError:
        raise
    except zipfile.BadZipFile as error:
        _refuse(path, str(error))
    except Exception as error:  # a damaged archive or pickle can raise anything
        if isinstance(error, OSError) and error.filename is not None:
            raise   # the file cannot be opened
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
    """Return the weights of a published FireNet checkpoint, from counts to intensity.

    A WeightsError says that `read_state_dict` refuses it, or that it is of another
    network.
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
