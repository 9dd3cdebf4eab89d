"""The calibration file: what goes in comes out, and what it refuses."""
import json
import pickle

import numpy as np
import pytest

from pdavis_cv import (
    ApsFrame,
    Calibration,
    CalibrationError,
    Layout,
    fuse,
    recording_from_arrays as record,
)
from pdavis_cv.pixel.model import PixelModel

SIZE = (4, 6)


def full():
    rng = np.random.default_rng(3)
    plane = rng.uniform(0.1, 0.3, SIZE)
    return Calibration(
        sensor_size=SIZE, chip="Davis346", serial="00000042", layout=Layout.SONY,
        theta_on=plane, theta_off=plane + 0.1, dark=-plane, dark_noise=plane,
        gain=plane + 1, analyser=rng.normal(size=(*SIZE, 3)), usable=plane > 0.15,
        clip_dn=900.0, bandwidth_hz=250.0, bandwidth_sigma=0.1,
        clock_offset_us=-3000.0, learned={
            "thresholds_sigma": 0.02, "clock_offset_sigma_us": 90.0,
            "black_dn": 25.0, "black_sigma_dn": 4.0, "model": PixelModel(
                theta=np.array([0.25, 0.2]), dead_s=1e-4,
                by_class=rng.normal(size=(2, 5)))},
        notes={"wavelength_nm": 500})


def test_a_file_gives_back_what_was_saved(tmp_path):
    one = full()
    other = Calibration.load(one.save(tmp_path / "camera.npz"))
    assert other.parts == one.parts
    assert (other.serial, other.chip, other.sensor_size) == (
        one.serial, one.chip, one.sensor_size)
    assert dict(other.notes) == dict(one.notes)
    assert dict(other.learned) == dict(one.learned)
    for name in set(one.parts) - set(one.learned):
        np.testing.assert_array_equal(getattr(other, name), getattr(one, name))
    assert [path.name for path in tmp_path.iterdir()] == ["camera.npz"]


def test_a_file_of_an_earlier_version_has_no_uncertainty_of_the_bandwidth(tmp_path):
    path = full().save(tmp_path / "camera.npz")
    with np.load(path) as data:
        arrays = dict(data)
    head = json.loads(str(arrays.pop("head")))
    del head["bandwidth_sigma"]
    np.savez(path, head=np.array(json.dumps(head)), **arrays)
    other = Calibration.load(path)
    assert other.bandwidth_sigma is None
    assert other.bandwidth_hz == 250.0


@pytest.mark.parametrize(("name", "value"), [
    ("theta", [0.2]), ("noise", [1.0, float("nan"), 2.0]), ("theta", None),
    ("rest_s", "long"), (None, "none"), (None, {}), ("layout", "x"), ("layout", [[]])])
def test_a_damaged_model_is_refused(tmp_path, name, value):
    path = full().save(tmp_path / "camera.npz")
    with np.load(path) as data:
        arrays = dict(data)
    head = json.loads(str(arrays.pop("head")))
    if name is None:
        head["learned"]["model"] = value
    elif name == "layout":
        head[name] = value
    else:
        head["learned"]["model"][name] = value
    np.savez(path, head=np.array(json.dumps(head)), **arrays)
    with pytest.raises(CalibrationError, match="damaged"):
        Calibration.load(path)


@pytest.mark.parametrize("learned", [
    {"black": 2.0}, {"black_sigma_dn": -1.0}, {"thresholds_sigma": float("nan")},
    {"black_dn": "dark"}, {"model": {"theta": [0.2, 0.2]}}])
def test_what_cannot_be_learned_is_refused(learned):
    with pytest.raises(ValueError, match="learned must hold positive"):
        Calibration(sensor_size=SIZE, learned=learned)


def test_arrays_are_copies_and_read_only():
    dark = np.zeros(SIZE, np.float32)
    calibration = Calibration(sensor_size=SIZE, dark=dark)
    dark[0, 0] = 7
    assert calibration.dark[0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        calibration.dark[0, 0] = 1


def test_merge_takes_the_other_s_parts_and_refuses_another_camera():
    dark = Calibration(sensor_size=SIZE, serial="1", dark=np.ones(SIZE))
    clip = Calibration(sensor_size=SIZE, clip_dn=900.0, notes={"a": 1})
    merged = dark.merge(clip)
    assert merged.parts == ("dark", "clip_dn")
    assert merged.serial == "1"
    assert merged.notes == {"a": 1}
    with pytest.raises(CalibrationError, match="serial is 1 here and 2 there"):
        dark.merge(Calibration(sensor_size=SIZE, serial="2"))
    with pytest.raises(CalibrationError, match="sensor_size"):
        dark.merge(Calibration(sensor_size=(2, 2)))
    with pytest.raises(CalibrationError, match="layout"):
        Calibration(sensor_size=SIZE, layout=Layout.SONY).merge(
            Calibration(sensor_size=SIZE, layout=Layout.PDAVIS))


@pytest.mark.parametrize(("parts", "message"), [
    ({"dark": np.zeros((2, 2))}, r"dark must have shape \(4, 6\)"),
    ({"gain": np.zeros(SIZE)}, "gain must be positive everywhere, got 0.0 at x=0, y=0"),
    ({"dark": np.full(SIZE, np.nan)}, "dark must be finite"),
    ({"theta_on": np.ones(SIZE)}, "must be given together"),
    ({"clip_dn": -1}, "clip_dn must be positive"),
    ({"usable": np.ones(SIZE)}, "usable must be bool"),
])
def test_impossible_parts_are_refused(parts, message):
    with pytest.raises(ValueError, match=message):
        Calibration(sensor_size=SIZE, **parts)


def test_damaged_foreign_and_newer_files_are_refused_by_name(tmp_path):
    good = full().save(tmp_path / "camera.npz").read_bytes()
    bad = tmp_path / "bad.npz"
    for content in (b"", b"hello", good[:200], good[:-30],
                    pickle.dumps({"dark": 1})):
        bad.write_bytes(content)
        with pytest.raises(CalibrationError, match=r"bad\.npz"):
            Calibration.load(bad)
    np.savez(bad, head=np.array(json.dumps({"format_version": 99})))
    with pytest.raises(CalibrationError, match="version 99 is newer"):
        Calibration.load(bad)
    np.savez(bad, dark=np.zeros(3))
    with pytest.raises(CalibrationError, match="not a calibration"):
        Calibration.load(bad)
    with pytest.raises(FileNotFoundError):
        Calibration.load(tmp_path / "missing.npz")


def test_a_text_with_characters_that_there_are_not_is_refused(tmp_path):
    path = tmp_path / "x.npz"
    text = np.array(["{}" + " " * 8])
    text.view("u4")[3] = 0x7FFFFFFF
    np.savez(path, head=text.reshape(()))
    with pytest.raises(CalibrationError, match="characters that there are not"):
        Calibration.load(path)


def test_fuse_takes_dark_gain_and_unusable_pixels_out():
    dn = np.full(SIZE, 220.0, np.float32)
    recording = record(None, [ApsFrame(dn, 0, 2_000)], sensor_size=SIZE)
    usable = np.ones(SIZE, bool)
    usable[0, 5] = False
    calibration = Calibration(
        sensor_size=SIZE, dark=np.full(SIZE, 20), gain=np.full(SIZE, 2.0),
        layout=Layout.SONY, usable=usable)
    image, = fuse(recording, calibration=calibration, times_us=[2_000])
    np.testing.assert_allclose(image.quad[:, 1, 1], (220 - 20) * 2 / 2, rtol=1e-6)
    assert not image.valid[0, 5]
    assert image.valid[3, 0]
    assert image.provenance["layout"] == "((90, 45), (135, 0))"
