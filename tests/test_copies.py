"""Copies in the formats that are written: what is known of a source, and how well."""
import json

import numpy as np
import pytest

import pdavis_cv
from pdavis_cv import Sensor, fuse, open_recording
from pdavis_cv.recording.facts import ASSUMED, FILE, MEASURED, Fact, stated, text_of
from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.recording.registry import FORMATS, writer_for

pytest.importorskip("h5py")

PLAIN = {"es", "numpy", "text"}
"""Formats with no place for what is known of the source."""
WRITTEN = sorted(name for name, one in FORMATS.usable().items()
                 if one.writer and name not in PLAIN)
FRAMES = sorted(name for name in WRITTEN if "frames" in FORMATS[name].holds)
SIZE = (260, 346)


def copy(recording, folder, kind):
    path = folder / f"copy-{kind}{FORMATS[kind].written[0]}"
    writer_for(path, kind)[1](path, recording)
    return open_recording(path)


@pytest.fixture(scope="module")
def stack(tmp_path_factory):
    """Images of which the file says neither times nor full scale nor exposure."""
    path = tmp_path_factory.mktemp("stack") / "x.npy"
    np.save(path, np.random.default_rng(0).integers(0, 900, (3, *SIZE), np.uint16))
    return path


@pytest.mark.parametrize("kind", FRAMES)
@pytest.mark.parametrize(("given", "rate", "scale"), [
    ({}, Fact(25.0, ASSUMED), Fact(4095, ASSUMED)),
    ({"source_fps": 50, "bits": 12, "exposure_us": 900}, Fact(50, FILE),
     Fact(4095, FILE))])
def test_what_was_assumed_is_assumed_in_a_copy(
        stack, tmp_path, kind, given, rate, scale):
    with (open_recording(stack, layout="sony", **given) as source,
          copy(source, tmp_path, kind) as again,
          copy(again, tmp_path / "..", kind) as third):
        for facts in again.info.facts, third.info.facts:
            assert facts["frame_times"] == rate
            assert facts["sensor"] == Fact(Sensor.SONY, FILE)
            assert facts["layout"].value == source.info.layout
            assert facts.get("exposure_us") == (
                Fact(900, FILE) if given else None)
            # A DAVIS, whose files jAER reads, has 10 bits.
            assert facts["full_scale_dn"] == (
                Fact(1023, FILE) if kind == "aedat2" else scale)
        frames = next(again.packets()).frames
        assert frames[0].full_scale_dn == again.info.full_scale_dn
        assert again.info.wall_clock_us is None


@pytest.mark.parametrize("kind", FRAMES)
def test_a_full_scale_that_was_measured_is_so_in_a_copy(tmp_path, kind):
    image = np.random.default_rng(0).integers(0, 900, SIZE, np.uint16)
    image[::3] = 1023
    np.save(tmp_path / "x.npy", image)
    with (open_recording(tmp_path / "x.npy", layout="sony") as source,
          copy(source, tmp_path, kind) as again):
        assert again.info.facts["full_scale_dn"] == Fact(1023, MEASURED)


@pytest.mark.parametrize("kind", WRITTEN)
def test_a_sensor_that_nobody_named_is_unknown_in_a_copy(tmp_path, kind):
    (tmp_path / "x.txt").write_text("".join(
        f"{0.001 * k:.6f} {k % 300} {k % 200} {k % 2}\n" for k in range(500)))
    with (open_recording(tmp_path / "x.txt") as source,
          copy(source, tmp_path, kind) as again):
        assert again.info.facts["sensor_size"] == Fact(SIZE, ASSUMED)
        assert again.info.sensor is None


@pytest.mark.parametrize("kind", sorted(set(FRAMES) - {"aedat2"}))
def test_a_copy_of_four_planes_gives_their_images(tmp_path, kind):
    planes = np.random.default_rng(0).integers(1, 900, (2, 4, 6, 8), np.uint16)
    np.save(tmp_path / "x.npy", planes)
    with (open_recording(tmp_path / "x.npy") as source,
          copy(source, tmp_path, kind) as again):
        assert again.info.demosaic == "superpixel"
        images = [image.quad for image in fuse(again)]
    np.testing.assert_allclose(images, planes, rtol=1e-6)


@pytest.mark.parametrize("kind", WRITTEN)
def test_a_copy_keeps_the_biases_and_so_the_thresholds(tmp_path, kind):
    events = np.zeros(50, pdavis_cv.EVENT_DTYPE)
    events["t"] = np.arange(50)
    codes = {f"AddressedIPotCF.{name}.BitValue{part}": str(code)
             for name, values in (("OnBn", (3, 250)), ("OffBn", (3, 9)))
             for part, code in zip(("Coarse", "Fine"), values, strict=True)}
    with pdavis_cv.Aedat2Writer(tmp_path / "x.aedat", sensor_size=SIZE,
                                preferences=codes) as writer:
        writer.add(pdavis_cv.Packet(events=events))
    with (open_recording(tmp_path / "x.aedat") as source,
          copy(source, tmp_path, kind) as again):
        assert source.info.biases.keys() == {"OnBn", "OffBn"}
        assert again.info.biases == pytest.approx(dict(source.info.biases))
        assert again.info.sensor is Sensor.DAVIS346


@pytest.mark.parametrize("text", [
    "", "{", "[]", "{}", "[" * 100_000, '{"facts": 3, "origins": {}, "biases": {}}',
    json.dumps({"facts": {"layout": "x"}, "origins": {}, "biases": {}}),
    json.dumps({"facts": {"full_scale_dn": -4}, "origins": {}, "biases": {}}),
    json.dumps({"facts": {}, "origins": {}, "biases": {"OnBn": "x"}})])
def test_a_damaged_text_says_nothing(text):
    found = stated(SourceOptions(), text, sensor_size=(2, 4), sensor=Sensor.DAVIS346)
    assert found == stated(SourceOptions(), sensor_size=(2, 4), sensor=Sensor.DAVIS346)


def test_a_caller_outdoes_what_a_copy_says():
    text = text_of({"frame_times": Fact(25.0, ASSUMED), "sensor_size": Fact(
        (2, 4), ASSUMED)}, None, {})
    found = stated(SourceOptions(sensor="pdavis"), text, sensor_size=(2, 4))
    assert found["sensor"] is Sensor.PDAVIS
    assert found["origins"]["sensor"] == "caller"
    assert found["origins"]["sensor_size"] == ASSUMED
    with pytest.raises(ValueError, match="one of them is wrong"):
        stated(SourceOptions(sensor_size=(9, 9)), text, sensor_size=(2, 4))
