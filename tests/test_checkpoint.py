"""pdavis weights: checkpoints are read without torch and without being run."""
import io
import json
import pickle
import struct
import sys
import zipfile
from collections import OrderedDict

import numpy as np
import pytest

from pdavis_cv import WeightsError
from pdavis_cv.reconstruct.checkpoint import _Tensor, firenet_weights, read_state_dict
from pdavis_cv.reconstruct.weights import Weights
from pdavis_cv.tools.main import main

GATES = ("update_gate", "reset_gate", "out_gate")


def shapes():
    """Names and shapes of a published FireNet's state dict."""
    named = {"net.head.conv.conv2d": (16, 5, 3, 3), "net.pred.conv2d": (1, 16, 1, 1)}
    for block in ("net.head", "net.resblocks.0"):
        for gate in GATES:
            named[f"{block}.recurrent_block.{gate}"] = (16, 32, 3, 3)
    for block in ("net.resblocks.0.conv", "net.resblocks.1"):
        for i in (1, 2):
            named[f"{block}.conv{i}"] = (16, 16, 3, 3)
    return named


def arrays(seed=0):
    random = np.random.default_rng(seed)
    out = {}
    for name, shape in shapes().items():
        out[f"{name}.weight"] = random.normal(size=shape).astype(np.float32)
        out[f"{name}.bias"] = random.normal(size=shape[0]).astype(np.float32)
    return out


class Writer:
    """torch.save's format by hand: protocol 2, persistent ids, a file per tensor."""

    def __init__(self):
        self.files, self.counts, self.body = [], [], [b"\x80\x02"]

    def text(self, value):
        data = value.encode()
        self.body.append(b"X" + struct.pack("<I", len(data)) + data)

    def number(self, value):
        self.body.append(b"J" + struct.pack("<i", value))

    def named(self, module, name):
        self.body.append(f"c{module}\n{name}\n".encode())

    def persistent(self, numel, view=None):
        self.number(numel)

    def tensor(self, array, kind="FloatStorage", *, offset=0, stride=None, size=None,
               view=None):
        self.named("torch._utils", "_rebuild_tensor_v2")
        self.body.append(b"((")
        self.text("storage")
        self.named("torch", kind)
        self.text(str(len(self.files)))
        self.text("cpu")
        self.persistent(array.size, view)
        self.body.append(b"tQ")
        self.counts.append(array.size)
        self.files.append(np.ascontiguousarray(array).tobytes())
        self.number(offset)
        for sides in (size or array.shape,
                      stride or [s // array.itemsize for s in array.strides]):
            self.body.append(b"(")
            for side in sides:
                self.number(side)
            self.body.append(b"t")
        self.body.append(b"\x89")
        self.named("collections", "OrderedDict")
        self.body.append(b")RtR")

    def write(self, path, folder="archive", extra=b""):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(f"{folder}/data.pkl", b"".join(self.body) + extra + b".")
            for i, data in enumerate(self.files):
                archive.writestr(f"{folder}/data/{i}", data)


class LegacyWriter(Writer):
    """torch.save's format before torch 1.6 by hand: one stream, numbers at its end."""

    magic = b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19."
    version = b"\x80\x02M\xe9\x03."
    machine = (b"\x80\x02}q\x00(X\x10\x00\x00\x00protocol_versionq\x01M\xe9\x03"
               b"X\x0d\x00\x00\x00little_endianq\x02\x88"
               b"X\x0a\x00\x00\x00type_sizesq\x03}q\x04(X\x05\x00\x00\x00shortq\x05"
               b"K\x02X\x03\x00\x00\x00intq\x06K\x04X\x04\x00\x00\x00longq\x07K\x04"
               b"uu.")

    def persistent(self, numel, view=None):
        self.number(numel)
        if view is None:
            self.body.append(b"N")
        else:
            self.body.append(b"(")
            self.text(view[0])
            for value in view[1:]:
                self.number(value)
            self.body.append(b"t")

    def write(self, path, folder="", extra=b"", counts=None):
        names = b"\x80\x02](" + b"".join(
            b"X" + struct.pack("<I", len(str(i))) + str(i).encode()
            for i in range(len(self.files))) + b"e."
        numbers = b"".join(
            struct.pack("<q", count) + data for count, data in zip(
                counts or self.counts, self.files, strict=True))
        path.write_bytes(self.magic + self.version + self.machine
                         + b"".join(self.body) + extra + b"." + names + numbers)


def write(path, state, kind="FloatStorage", writer=None):
    """Write {"arch", "state_dict", "optimizer"} as the trainer of FireNet did."""
    writer = writer or Writer()
    writer.body.append(b"}(")
    writer.text("arch")
    writer.text("FireNet")
    writer.text("state_dict")
    writer.named("collections", "OrderedDict")
    writer.body.append(b")R(")
    for name, array in state.items():
        writer.text(name)
        writer.tensor(array, kind)
    writer.body.append(b"u")
    writer.text("optimizer")
    writer.body.append(b"}(")
    writer.text("state")
    writer.tensor(np.zeros((2, 2), np.float32))
    writer.body.append(b"uu")
    writer.write(path)


@pytest.fixture
def checkpoint(tmp_path):
    write(tmp_path / "firenet.pth.tar", arrays())
    return tmp_path / "firenet.pth.tar"


def test_a_checkpoint_becomes_weights_without_torch(checkpoint, tmp_path, capsys):
    out = tmp_path / "firenet.npz"
    before = "torch" in sys.modules
    assert main(["weights", "convert", str(checkpoint), "-o", str(out)]) == 0
    assert ("torch" in sys.modules) == before
    assert "37777 weights" in capsys.readouterr().out
    weights, state = Weights.load(out), arrays()
    assert (weights.network, weights.unit) == ("firenet", None)
    np.testing.assert_array_equal(
        weights.arrays["g2.gates.weight"][16:],
        state["net.resblocks.0.recurrent_block.reset_gate.weight"])
    np.testing.assert_array_equal(
        weights.arrays["g1.gates.bias"][:16],
        state["net.head.recurrent_block.update_gate.bias"])
    np.testing.assert_array_equal(
        weights.arrays["r1.b.weight"], state["net.resblocks.0.conv.conv2.weight"])
    assert main(["weights", "show", str(out)]) == 0
    assert "firenet: 37777 weights" in capsys.readouterr().out
    assert main(["weights", "show", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["network"], told["weights"]) == ("firenet", 37777)


def test_what_torch_saves_is_read(tmp_path):
    torch = pytest.importorskip("torch")
    state = OrderedDict((name, torch.from_numpy(value))
                        for name, value in arrays().items())
    state["net.pred.conv2d.weight"] = torch.nn.Parameter(
        state["net.pred.conv2d.weight"])
    path = tmp_path / "firenet.pth.tar"
    torch.save({"arch": "FireNet", "epoch": 3, "config": {"a": [1, 2.5, None, True]},
                "state_dict": state}, path)
    for name, value in read_state_dict(path).items():
        np.testing.assert_array_equal(value, arrays()[name])
    assert firenet_weights(path).parameters == 37_777
    turned = torch.arange(12.0).reshape(3, 4)[1:].T
    torch.save({"state_dict": {"x": turned, "n": torch.tensor(7)}}, path)
    found = read_state_dict(path)
    np.testing.assert_array_equal(found["x"], turned.numpy())
    assert found["n"] == 7


class Bomb:
    def __init__(self, call, *arguments):
        self.reduced = call, arguments

    def __reduce__(self):
        return self.reduced


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_a_malicious_pickle_is_refused_and_not_run(tmp_path, protocol):
    path, hit = tmp_path / "evil.pth.tar", tmp_path / "hit"
    for bomb in (Bomb(exec, f"open({str(hit)!r}, 'w')"), Bomb(io.open, str(hit), "w"),
                 Bomb(getattr, OrderedDict, "clear")):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("archive/data.pkl", pickle.dumps(
                {"state_dict": {"x": bomb}}, protocol))
        with pytest.raises(WeightsError, match=r"evil\.pth\.tar: refused, its pickle"):
            read_state_dict(path)
    assert not hit.exists()
    assert main(["weights", "convert", str(path), "-o", str(tmp_path / "w.npz")]) == 2
    assert not (tmp_path / "w.npz").exists()


def test_what_stands_for_torch_cannot_be_tampered_with(tmp_path):
    path = tmp_path / "evil.pth.tar"
    for module, name in (("torch._utils", "_rebuild_tensor_v2"),
                         ("collections", "OrderedDict")):
        writer = Writer()
        writer.named(module, name)
        writer.body.append(b"N}(")
        writer.text("__doc__")
        writer.text("mine")
        writer.body.append(b"u\x86b")
        writer.write(path)
        with pytest.raises(WeightsError, match="not a checkpoint that can be read"):
            read_state_dict(path)
    assert OrderedDict.__doc__ != "mine"


def test_tensors_that_reach_beyond_their_storage_are_refused(tmp_path):
    path = tmp_path / "evil.pth.tar"
    array = np.zeros((2, 3), np.float32)
    for bad in ({"offset": 1}, {"offset": -1}, {"stride": (1000, 1)},
                {"stride": (-1, 1)}, {"size": (3, 3)}, {"size": (2, 3, 1)},
                {"size": (9999, 9999), "stride": (0, 0)}):
        writer = Writer()
        writer.body.append(b"}(")
        writer.text("x")
        writer.tensor(array, **bad)
        writer.body.append(b"u")
        writer.write(path)
        with pytest.raises(WeightsError, match=r"evil\.pth\.tar: not a checkpoint"):
            read_state_dict(path)


def test_a_pickle_that_would_fill_the_memory_is_refused(tmp_path):
    path = tmp_path / "evil.pth.tar"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/data.pkl", b"\x80\x02}r" + struct.pack("<I", 2**31) + b".")
    with pytest.raises(WeightsError, match="memo 2147483648 in a pickle of"):
        read_state_dict(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a/data.pkl", bytes(1 << 25))
    with pytest.raises(WeightsError, match=r"data\.pkl of 33554432 bytes"):
        read_state_dict(path)


def test_truncated_and_foreign_files_are_refused_by_name(checkpoint, tmp_path, capsys):
    data = checkpoint.read_bytes()
    for cut in (0, 100, len(data) // 2, len(data) - 1):
        checkpoint.write_bytes(data[:cut])
        with pytest.raises(WeightsError, match=r"firenet\.pth\.tar: not a checkpoint"):
            read_state_dict(checkpoint)
    with zipfile.ZipFile(checkpoint, "w") as archive:
        archive.writestr("hello.txt", "hello")
    with pytest.raises(WeightsError, match=r"no data\.pkl in it"):
        read_state_dict(checkpoint)
    checkpoint.write_bytes(data[:2000] + bytes(9) + data[2009:])
    with pytest.raises(WeightsError):
        read_state_dict(checkpoint)
    out = ["-o", str(tmp_path / "w.npz")]
    assert main(["weights", "convert", str(tmp_path / "none"), *out]) == 2
    assert main(["weights", "convert", str(checkpoint), "-o", "w.txt"]) == 2
    assert main(["weights"]) == 2
    assert "--out must end in .npz" in capsys.readouterr().err


def test_a_state_dict_of_another_network_is_refused_by_name(tmp_path):
    path, state = tmp_path / "other.pth.tar", arrays()
    cases = [
        ({k: v for k, v in state.items() if "pred" not in k},
         r"not a FireNet, it has no 'net\.pred\.conv2d\.weight'"),
        ({**state, "net.extra": np.zeros(3, np.float32)}, "it also has 'net.extra'"),
        ({**state, "net.pred.conv2d.bias": np.zeros(3, np.float32)},
         r"pred\.bias must have shape \(1,\), got \(3,\)"),
        ({}, "no state_dict of arrays"),
    ]
    for wrong, message in cases:
        write(path, wrong)
        with pytest.raises(WeightsError, match=message):
            firenet_weights(path)


# Before torch 1.6 ---------------------------------------------------------------


def test_a_legacy_checkpoint_gives_the_same_weights(tmp_path, capsys):
    state = arrays()
    write(tmp_path / "new.pth.tar", state)
    write(tmp_path / "old.pth.tar", state, writer=LegacyWriter())
    assert (tmp_path / "old.pth.tar").read_bytes()[:2] == b"\x80\x02"
    new, old = (
        firenet_weights(tmp_path / f"{name}.pth.tar") for name in ("new", "old"))
    assert new.digest == old.digest
    out = tmp_path / "w.npz"
    assert main(["weights", "convert", str(tmp_path / "old.pth.tar"), "-o", str(out)]
                ) == 0
    assert Weights.load(out).digest == old.digest


@pytest.mark.parametrize(("kind", "dtype"), [
    ("FloatStorage", "<f4"), ("DoubleStorage", "<f8"), ("HalfStorage", "<f2"),
    ("LongStorage", "<i8"), ("ByteStorage", "<u1")])
def test_legacy_storages_of_every_type_stand_one_after_the_other(tmp_path, kind, dtype):
    random = np.random.default_rng(3)
    one = random.integers(0, 100, (3, 4)).astype(dtype)
    two = random.integers(0, 100, 7).astype(dtype)
    writer = LegacyWriter()
    writer.body.append(b"}(")
    writer.text("one")
    writer.tensor(one.T.copy().T, kind, stride=(4, 1))
    writer.text("two")
    writer.tensor(two, kind, size=(3,), stride=(2,), offset=1)
    writer.body.append(b"u")
    writer.write(tmp_path / "x.pt")
    found = read_state_dict(tmp_path / "x.pt")
    np.testing.assert_array_equal(found["one"], np.ascontiguousarray(one.T.copy().T))
    np.testing.assert_array_equal(found["two"], two[1:7:2])
    assert found["two"].dtype == np.dtype(dtype)


def test_a_tensor_keeps_to_the_memory_of_its_storage():
    numbers = np.arange(12.0)
    assert _Tensor()(numbers, 2, (2, 3), (4, 1)).tolist() == [[2, 3, 4], [6, 7, 8]]
    assert _Tensor()(numbers[::2], 1, (2,), (2,)).tolist() == [2, 6]
    # As storages whose numbers are not known yet.
    assert _Tensor()(np.broadcast_to(numbers[:1], 9), 0, (9,), (1,)).tolist() == [0] * 9


def test_a_legacy_view_is_a_part_of_its_storage(tmp_path):
    array = np.arange(10, dtype=np.float32)
    writer = LegacyWriter()
    writer.body.append(b"}(")
    writer.text("x")
    writer.tensor(array, view=("9", 4, 3), size=(3,), stride=(1,))
    writer.body.append(b"u")
    writer.write(tmp_path / "x.pt")
    np.testing.assert_array_equal(
        read_state_dict(tmp_path / "x.pt")["x"], array[4:7])


def test_the_objects_of_a_training_program_are_passed_over(tmp_path):
    writer = LegacyWriter()
    writer.body.append(b"}(")
    writer.text("logger")
    writer.named("logger.logger", "Logger")
    writer.body.append(b")\x81}(")   # an instance, and its state
    writer.text("entries")
    writer.body.append(b"}ub")
    writer.text("monitor_best")     # a NumPy scalar
    writer.named("numpy.core.multiarray", "scalar")
    writer.named("numpy", "dtype")
    writer.text("f8")
    writer.body.append(b"K\x00K\x01\x87R")
    writer.text("12345678")
    writer.body.append(b"\x86R")
    writer.text("state_dict")
    writer.body.append(b"}(")
    writer.text("x")
    writer.tensor(np.arange(3, dtype=np.float32))
    writer.body.append(b"uu")
    writer.write(tmp_path / "x.pt")
    assert list(read_state_dict(tmp_path / "x.pt")) == ["x"]


@pytest.mark.parametrize("place", ["version", "machine", "object", "names"])
def test_a_malicious_legacy_pickle_is_refused_and_not_run(tmp_path, place):
    path, hit = tmp_path / "evil.pt", tmp_path / "hit"
    writer = LegacyWriter()
    bomb = pickle.dumps(Bomb(exec, f"open({str(hit)!r}, 'w')"), 2)
    writer.body.append(b"}")
    if place == "object":
        writer.body = [bomb[:-1]]
    writer.write(path)
    if place in ("version", "machine"):
        setattr(writer, place, bomb)
        writer.write(path)
    elif place == "names":
        data = path.read_bytes()
        path.write_bytes(data[:data.index(b"\x80\x02](")] + bomb)
    with pytest.raises(WeightsError, match=r"evil\.pt: refused, its pickle asks for"):
        read_state_dict(path)
    assert not hit.exists()


def test_legacy_sizes_are_checked_before_anything_is_allocated(tmp_path):
    path = tmp_path / "x.pt"
    array = np.zeros((2, 3), np.float32)
    for bad, message in (({"offset": 1}, "a tensor of size"),
                         ({"size": (9999, 9999), "stride": (0, 0)}, "a tensor of size"),
                         ({"view": ("9", 4, 3)}, "a view of 4 .. 7 of 6"),
                         ({"view": ("9", -1, 6)}, "a view of -1 .. 5 of 6")):
        writer = LegacyWriter()
        writer.body.append(b"}(")
        writer.text("x")
        writer.tensor(array, **bad)
        writer.body.append(b"u")
        writer.write(path)
        with pytest.raises(WeightsError, match=message):
            read_state_dict(path)
    for counts in ([7], [-1], [1 << 62]):
        writer = LegacyWriter()
        writer.body.append(b"}(")
        writer.text("x")
        writer.tensor(array)
        writer.body.append(b"u")
        writer.write(path, counts=counts)
        with pytest.raises(WeightsError, match=f"of {counts[0]} numbers, 6 expected"):
            read_state_dict(path)
    writer.write(path)
    data = path.read_bytes()
    for cut in range(14, len(data), 7):
        path.write_bytes(data[:cut])
        with pytest.raises(WeightsError, match="not a checkpoint"):
            read_state_dict(path)
    big = data.replace(b"little_endianq\x02\x88", b"little_endianq\x02\x89")
    path.write_bytes(big)
    with pytest.raises(WeightsError, match="not little-endian"):
        read_state_dict(path)


def test_what_torch_saved_before_1_6_is_read(tmp_path):
    torch = pytest.importorskip("torch")
    value = torch.arange(12.).reshape(3, 4)
    torch.save({"state_dict": {"x": value[:, 1:].t()}}, tmp_path / "x.pt",
               _use_new_zipfile_serialization=False)
    np.testing.assert_array_equal(
        read_state_dict(tmp_path / "x.pt")["x"], value[:, 1:].t().numpy())
