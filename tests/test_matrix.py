"""Every reader with every command and output, on small files.

A format that can be written joins by its writer, another one by its line in MADE; a
format with neither fails `test_every_format_is_in_the_matrix`.
"""
import importlib.util
import json

import event_bytes
import numpy as np
import pytest
from aedat31_bytes import aedat31_file
from davis_words import write_trace

import pdavis_cv
from pdavis_cv import ApsFrame, Layout, VideoCapture, batch, open_recording
from pdavis_cv.fusion import Fusion
from pdavis_cv.recording.registry import FORMATS
from pdavis_cv.registry import loaded
from pdavis_cv.tools.main import main

cv2 = pytest.importorskip("cv2")
SIZE = (16, 24)
FRAMES = 6


def light(size=SIZE):
    """Return frames of polarized light and events, 0.25 s."""
    rng = np.random.default_rng(0)
    events = np.zeros(2000, pdavis_cv.EVENT_DTYPE)
    events["t"] = np.sort(rng.choice(250_000, len(events), replace=False))
    for name, most in (("x", size[1]), ("y", size[0]), ("p", 2)):
        events[name] = rng.integers(0, most, len(events))
    frames = [ApsFrame(image.astype(np.float32), 40_000 * k, 40_000 * k + 5_000,
                       available_us=40_000 * k + 8_000)
              for k, image in enumerate(mosaics(size))]
    return pdavis_cv.recording_from_arrays(events, frames, sensor_size=size)


def mosaics(size=SIZE):
    angles = np.deg2rad(np.tile(Layout.PDAVIS.angles_deg, (size[0] // 2, size[1] // 2)))
    return [np.rint(400 * (1 + 0.5 * np.cos(2 * (0.3 + 0.2 * k - angles)))).astype(
        np.uint16) for k in range(FRAMES)]


def stills(folder):
    for k, image in enumerate(mosaics()):
        cv2.imwrite(str(folder / f"shot_{k}.png"), image)
    return folder / "shot_%d.png"


def several(folder):
    stills(folder)
    return [folder / f"shot_{k}.png" for k in range(FRAMES)]


def usb(folder):
    write_trace(folder / "x.usb", light())
    return folder / "x.usb"


def of_bytes(name, make):
    def made(folder):
        (folder / name).write_bytes(make())
        return folder / name
    return made


def of_events(name, make):
    return of_bytes(name, lambda: make(light().events()))


def sized(name, make):
    return of_bytes(name, lambda: make(light().events(), SIZE))


def rpg(folder):
    pytest.importorskip("h5py")
    event_bytes.rpg_file(folder / "rpg.h5", light())
    return folder / "rpg.h5"


def metavision(folder):
    h5py = pytest.importorskip("h5py")
    events = light().events()
    records = np.zeros(len(events), [
        ("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    for name in "txyp":
        records[name] = events[name]
    with h5py.File(folder / "metavision.h5", "w") as file:
        file.attrs["geometry"] = f"{SIZE[1]}x{SIZE[0]}"
        file["CD/events"] = records
    return folder / "metavision.h5"


def ros1(folder):
    pytest.importorskip("rosbags")
    event_bytes.ros1_file(folder / "x.bag", light().events(), SIZE)
    return folder / "x.bag"


def tiff(folder):
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(folder / "stack.tif", np.stack(mosaics()))
    return folder / "stack.tif"


MADE = {
    "aedat3": [of_bytes("x.aedat", lambda: aedat31_file(light()))],
    "metavision": [metavision], "rpg": [rpg], "davis-usb": [usb], "rosbag": [ros1],
    "prophesee": [sized("x.raw", event_bytes.evt3_file),
                  sized("x.dat", event_bytes.dat_file)],
    "es": [sized("x.es", event_bytes.es_file)],
    "text": [of_events("x.txt", event_bytes.text_file)],
    "images": [stills, several, tiff],
    "numpy": [of_events("x.npy", event_bytes.npy_file)],
}
"""Functions that make a small source of a format in a folder."""


def makers():
    """Yield (format, function) for each kind of source."""
    for name, one in FORMATS.usable().items():
        if one.writer is not None:
            def write(folder, one=one):
                path = folder / f"x{one.suffixes[0]}"
                # A file of AEDAT-2.0 names its size by its chip.
                loaded(one.writer)(path, light(
                    (128, 128) if one.name == "aedat2" else SIZE))
                return path
            yield name, write
        for make in MADE.get(name, ()):
            yield name, make


SOURCES = {f"{name}-{i}": (name, make) for i, (name, make) in enumerate(makers())}
OUTPUTS = [
    *(("export", "-o", f"{{out}}/x{suffix}") for suffix in (
        ".npy", ".npz", ".ome.tif", ".h5", ".png", ".webm")),
    ("info",), ("info", "--scan", "--json"), ("convert", "{out}/y.aedat4"),
    ("tendon", "--no-video", "-o", "{out}/tendon"),
    ("fan", "-o", "{out}/fan.webm", "--slow", "8", "--scale", "1"),
    ("batch", "-o", "{out}/batch", "--jobs", "1", "--executor", "process")]


def test_every_format_is_in_the_matrix():
    assert {name for name, _ in SOURCES.values()} == set(FORMATS.usable())


@pytest.fixture(scope="module", params=SOURCES)
def source(request, tmp_path_factory):
    """Return the paths of a source, and the numbers of its events and frames."""
    name, make = SOURCES[request.param]
    needs = FORMATS[name].extra
    if needs == "hdf5" and importlib.util.find_spec("h5py") is None:
        pytest.skip("h5py is not installed")
    made = make(tmp_path_factory.mktemp(name))
    paths = [str(one) for one in (made if isinstance(made, list) else [made])]
    with open_recording(paths, layout="pdavis") as recording:
        found = recording.scan()
    return paths, (found.event_count, found.frame_count)


@pytest.mark.gate
@pytest.mark.filterwarnings("ignore::pdavis_cv.PdavisWarning")
@pytest.mark.parametrize("output", OUTPUTS, ids=lambda args: "_".join(
    part.rpartition("/")[2].lstrip("-") for part in args))
def test_a_source_goes_into_an_output(source, output, tmp_path, capsys):
    paths, (events, frames) = source
    if output[0] == "batch" and len(paths) > 1:
        pytest.skip("each file is a recording of a batch")
    for needs, module in ((".h5", "h5py"), ("tendon", "matplotlib")):
        if any(needs in part for part in output) and (
                importlib.util.find_spec(module) is None):
            pytest.skip(f"{module} is not installed")
    command, *rest = (part.format(out=tmp_path) for part in output)
    fps = ["--fps", "50"] if command in ("export", "fan") else []
    code = main([command, *paths, *rest, "--layout", "pdavis", *fps])
    told = capsys.readouterr()
    if command in ("tendon", "fan") and not (events and frames) and code:
        assert code == 2, told.err          # what cannot hold the data says so
        assert told.err.count("\n") <= 2
        return
    assert code == 0, told.err
    if "--json" in rest:
        facts = json.loads(told.out)
        assert facts["facts"]["layout"]["origin"] == "caller"
        assert (facts["scan"]["event_count"], facts["scan"]["frame_count"]) == (
            events, frames)
        assert events in (0, 2000)
        assert events or frames == FRAMES
    elif command != "info":
        assert list(tmp_path.rglob("*"))


@pytest.mark.filterwarnings("ignore::pdavis_cv.PdavisWarning")
def test_a_source_is_a_video(source):
    paths, _ = source
    where = paths[0] if len(paths) == 1 else paths
    with VideoCapture(where, layout="pdavis", fps=50, output="aop_bgr") as capture:
        assert capture.isOpened(), capture.last_error
        ok, picture = capture.read()
        assert ok, capture.last_error
        assert picture.dtype == np.uint8
    with open_recording(where, layout="pdavis") as recording:
        assert all(member.size for member in recording.members)
        assert recording.info.facts["layout"].origin == "caller"
        assert recording.info.sensor in (
            pdavis_cv.Sensor.PDAVIS, pdavis_cv.Sensor.DAVIS346)


def test_polarization_of_a_picture_without_its_layout_is_refused(tmp_path, capsys):
    stills(tmp_path)
    path = str(tmp_path / "shot_0.png")
    capture = VideoCapture(path, output="aop_bgr")
    assert not capture.isOpened()
    assert 'layout="sony"' in capture.last_error
    assert VideoCapture(path).isOpened()        # as a picture, by cv2
    assert main(["export", path, "-o", str(tmp_path / "x.npy")]) == 2
    assert "--layout sony" in capsys.readouterr().err
    assert main(["info", path, "--layout", "sony", "--columns", "txyp"]) == 2
    assert "--columns is no option of" in capsys.readouterr().err


@pytest.mark.parametrize(("stated", "unit"), [([], "DN"), (["--exposure-us", "2000"],
                                                           "DN/ms")])
def test_light_of_an_unknown_exposure_is_in_dn(tmp_path, capsys, stated, unit):
    stills(tmp_path)
    assert main(["export", str(tmp_path / "shot_%d.png"), "--layout", "sony", *stated,
                 "-o", str(tmp_path / "x.npy"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["units"] == [unit, "rad", "1"]
    exposure_us = float(stated[1]) if stated else None
    with open_recording(tmp_path / "shot_%d.png", layout=Layout.SONY,
                        exposure_us=exposure_us) as recording:
        batch.Export(suffix=".npz", quantities=("quad", "dolp"))(
            recording, pdavis_cv.FusionOptions(), tmp_path)
    with np.load(tmp_path / "images.npz") as file:
        units = json.loads(str(file["provenance"]))["units"]
    assert (units["i0"], units["dolp"]) == (unit, "1")


@pytest.mark.parametrize(("stated", "assumed"), [
    ({"method": "cf"}, True), ({"method": "events"}, True),
    ({"method": "frames"}, False),                              # uses none
    ({"method": "kalman"}, False),                              # learns them
    ({"method": "cf", "thresholds": (0.3, 0.3)}, False),
    ({"method": "cf", "thresholds": "nominal"}, False),
    ({"method": "cf", "nominal_thresholds": (0.16, 0.18)}, False)])
def test_thresholds_that_nobody_stated_are_assumed(stated, assumed):
    found = Fusion(light(), layout=Layout.PDAVIS, **stated).provenance["assumed"]
    assert found == (["thresholds assumed (ON 0.2, OFF 0.2)"] if assumed else [])


@pytest.mark.gate
def test_an_assumed_rate_is_said_beside_what_it_changes(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    tifffile = pytest.importorskip("tifffile")
    angles = np.deg2rad(np.tile(Layout.SONY.angles_deg, (8, 8)))
    frames = [np.rint(2000 * (1 + (0.3 + 0.1 * np.sin(np.pi * k / 8)) * np.cos(
        2 * (0.4 - angles)))).astype(np.uint16) for k in range(80)]
    tifffile.imwrite(tmp_path / "stack.tif", np.stack(frames))
    run = ["tendon", str(tmp_path / "stack.tif"), "--layout", "sony", "--no-video",
           "-o", str(tmp_path / "out")]
    said = "rate assumed (25 per second)"
    assert main(run) == 0
    assert said in capsys.readouterr().out
    assert said in (tmp_path / "out" / "report.html").read_text()
    assert main([*run, "--json"]) == 0
    assert said in json.loads(capsys.readouterr().out)["assumed"]
    assert main([*run, "--source-fps", "50", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert said not in facts["assumed"]
    assert facts["load_hz"] == pytest.approx(50 / 16, rel=5e-3)
