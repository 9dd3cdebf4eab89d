"""Every command without each of the packages that need not be there: one line each."""
import sys
import zipfile

import numpy as np
import pytest
from event_bytes import ros1_file
from streams import random_events

import pdavis_cv
from pdavis_cv.data import example_recording
from pdavis_cv.tools.main import main

PACKAGES = {
    "av": "av", "cv2": "opencv-contrib-python-headless", "h5py": "h5py",
    "h5netcdf": "h5netcdf",
    "imageio": "imageio", "matplotlib": "matplotlib", "onnxruntime": "onnxruntime",
    "pims": "pims", "pyarrow": "pyarrow", "roifile": "roifile",
    "rosbags": "rosbags", "tifffile": "tifffile",
    "torch": "torch", "xarray": "xarray", "zarr": "zarr",
    "zstandard": "zstandard"}
"""Name in an import -> name for pip."""

LAYOUT = ("--layout", "pdavis", "--fps", "10", "--method", "cf")
COMMANDS = {
    "info": (("info", "{in}"), ()),
    "info --scan": (("info", "{in}", "--scan", "--json"), ()),
    "info of HDF5": (("info", "{h5}", "--scan"), ("h5py",)),
    "info of a bag": (("info", "{bag}", "--scan"), ("rosbags",)),
    "info of an image": (("info", "{png}", "--layout", "sony"), ("cv2",)),
    "info of a TIFF": (("info", "{tif}", "--layout", "sony"), ("tifffile",)),
    "info of a video": (("info", "{avi}", "--layout", "sony"), ("av",)),
    "info of zstd": (("info", "{zstd}", "--scan"), ("zstandard",)),
    "export npy": (("export", "{in}", "-o", "{out}.npy", *LAYOUT), ()),
    "export png": (("export", "{in}", "-o", "{out}.png", *LAYOUT), ("cv2",)),
    "export mp4": (("export", "{in}", "-o", "{out}.mp4", *LAYOUT), ("cv2",)),
    "export h5": (("export", "{in}", "-o", "{out}.h5", *LAYOUT), ("h5py",)),
    "export ome.tif": (
        ("export", "{in}", "-o", "{out}.ome.tif", *LAYOUT), ("tifffile",)),
    "export of an image": (
        ("export", "{png}", "-o", "{out}.npy", "--layout", "sony"), ("cv2",)),
    "export by a network": (
        ("export", "{in}", "-o", "{out}.npy", *LAYOUT, "--method", "firenet"), ()),
    "convert": (("convert", "{in}", "{out}.aedat4"), ()),
    "convert to HDF5": (("convert", "{in}", "{out}.h5"), ("h5py",)),
    "convert to a bag": (("convert", "{in}", "{out}.mcap"), ("rosbags",)),
    "export ome.zarr": (
        ("export", "{in}", "-o", "{out}.ome.zarr", *LAYOUT), ("zarr",)),
    "export to a bag": (
        ("export", "{in}", "-o", "{out}.mcap", *LAYOUT), ("cv2", "rosbags")),
    "convert to Parquet": (("convert", "{in}", "{out}.parquet"), ("pyarrow",)),
    "convert to zstd": (
        ("convert", "{in}", "{out}.aedat4", "--compression", "zstd"), ("zstandard",)),
    "calibrate dark": (("calibrate", "dark", "{in}", "-o", "{out}.npz"), ()),
    "calibrate check": (("calibrate", "check", "{h5}"), ("h5py",)),
    "score": (("score", "{in}", "-o", "{out}", "--methods", "cf", "--thresholds",
               "nominal"), ()),
    "simulate": (
        ("simulate", "polarizer", "-o", "{out}.aedat4", "--seconds", ".1"), ()),
    "fan": (("fan", SAMPLE := str(example_recording()), "-o", "{out}.mp4", *LAYOUT,
             "--centre", "172,129", "--radius", "9"), ("cv2",)),
    "tendon": (("tendon", SAMPLE, "-o", "{out}", "--layout", "pdavis", "--fps", "60"),
               ("cv2", "matplotlib", "tifffile")),
    "view": (("view", "{bag}", "--no-browser"), ("rosbags",)),
    "stream": (("stream", "{h5}"), ("h5py",)),
    "weights": (("weights", "convert", "{zip}", "-o", "{out}.npz"), ()),
}
"""Name -> (arguments, packages that it cannot do without)."""
UNUSABLE = ("weights",)
"""Of these the files here are nothing that the command can use, which it says."""
SERVE = ("view", "stream")
"""Commands that end when somebody ends them."""
LIGHT = [(name, package) for name, (_, needed) in COMMANDS.items()
         for package in needed]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Return a small recording in every form, by name."""
    cv2 = pytest.importorskip("cv2")
    folder = tmp_path_factory.mktemp("files")
    names = {name: folder / f"x.{name}" for name in (
        "h5", "bag", "png", "tif", "avi", "zstd", "zip")}
    names["in"] = folder / "in.aedat4"
    events = random_events(3000, (12, 16), seed=1)
    frames = [pdavis_cv.ApsFrame(np.full((12, 16), 300, np.float32), t, t + 2000,
                                 available_us=t + 3000)
              for t in range(0, int(events["t"][-1]), 20_000)]
    recording = pdavis_cv.recording_from_arrays(events, frames, sensor_size=(12, 16))
    pdavis_cv.write_aedat4(names["in"], recording)
    pdavis_cv.write_aedat4(names["zstd"], recording, compression="zstd")
    assert main(["convert", str(names["in"]), str(names["h5"])]) == 0
    ros1_file(names["bag"], events, (12, 16))
    cv2.imwrite(str(names["png"]), np.full((8, 8), 90, np.uint8))
    cv2.imwrite(str(names["tif"]), np.full((8, 8), 90, np.uint8),
                [cv2.IMWRITE_TIFF_COMPRESSION, 1])      # LZW is OpenCV's to read
    video = cv2.VideoWriter(str(names["avi"]), cv2.CAP_FFMPEG,
                            cv2.VideoWriter.fourcc(*"FFV1"), 25, (16, 16))
    video.write(np.full((16, 16, 3), 90, np.uint8))
    video.release()
    with zipfile.ZipFile(names["zip"], "w") as archive:
        archive.writestr("x/none", b"")
    return {name: str(path) for name, path in names.items()}


@pytest.fixture
def without(monkeypatch, tmp_path_factory):
    """Return a function that lets a package, and what is in it, fail to import.

    A process that is started finds a module that fails in the package's place.
    """
    folder = tmp_path_factory.mktemp("missing")
    monkeypatch.syspath_prepend(folder)

    def hide(package):
        (folder / f"{package}.py").write_text(
            f"raise ModuleNotFoundError('no {package}', name='{package}')")
        for name in [package, *sys.modules]:
            if name == package or name.startswith(package + "."):
                monkeypatch.setitem(sys.modules, name, None)

    return hide


def run(name, files, tmp_path):
    arguments, _ = COMMANDS[name]
    return main([one.format(**files, out=tmp_path / "out") for one in arguments])


@pytest.mark.parametrize(("name", "package"), LIGHT)
def test_a_package_that_is_needed_is_one_line_with_its_command(
        name, package, files, tmp_path, capsys, without):
    without(package)
    assert run(name, files, tmp_path) == 2
    text = capsys.readouterr().err
    assert f"pip install {PACKAGES[package]}" in text
    assert text.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.gate
@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in SERVE])
def test_packages_that_are_not_needed_are_not_missed(
        name, files, tmp_path, capsys, without):
    # A network runs in either of two packages.
    needed = COMMANDS[name][1] + ("onnxruntime",) * (name == "export by a network")
    for package in set(PACKAGES) - set(needed):
        without(package)
    code = run(name, files, tmp_path)
    said = capsys.readouterr().err
    assert "mistake of pdavis" not in said
    assert "pip install" not in said
    assert code == (2 if name in UNUSABLE else 0)


def test_without_matplotlib_numbers_are_written_and_the_picture_is_told(
        files, tmp_path, capsys, without):
    without("matplotlib")
    assert run("calibrate dark", files, tmp_path) == 0
    told = capsys.readouterr()
    assert "no picture: matplotlib is missing (pip install matplotlib)\n" in told.out
    assert "pip" not in told.err
    assert list(tmp_path.iterdir())


def test_a_network_needs_one_of_two_packages(files, tmp_path, capsys, without):
    without("onnxruntime")
    without("cv2")
    assert run("export by a network", files, tmp_path) == 2
    assert "pip install onnxruntime, or" in capsys.readouterr().err
