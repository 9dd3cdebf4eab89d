"""Stacks that other programs open: OME-TIFF, HDF5, NPZ; interrupted and continued."""
import hashlib
import json
import os
import signal
import subprocess
import sys
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from pdavis_cv import PolarFrame, open_recording
from pdavis_cv.export import (
    Hdf5File,
    NpyFile,
    NpzFile,
    OmeTiffFile,
    OmeZarrFile,
    provenance,
    to_xarray,
)
from pdavis_cv.quantities import quantity

NAMES = ("i0", "i45", "i90", "i135", "s0", "aop", "dolp")
FACTS = {"method": "cf", "parameters": {"cutoff_hz": 1.6}, "label": "größe µm <&>"}


def images(count, shape=(13, 17), start=1_000_000, step=5000):
    rng = np.random.default_rng(0)
    for k in range(count):
        valid = rng.uniform(size=shape) > 0.1
        yield PolarFrame(rng.uniform(1, 40, (4, *shape)), valid=valid,
                         t_us=start + k * step)


def expected(name, count):
    return np.stack([np.where(one.valid, quantity(name).of(one), np.nan)
                     for one in images(count)])


def write(kind, path, count=5, **options):
    with kind(path, NAMES, FACTS, **options) as file:
        for frame in list(images(count))[file.count:]:
            file.add(frame)
    return file


def test_ome_tiff_returns_numbers_axes_names_sizes_and_times(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    path = tmp_path / "stack.ome.tif"
    write(OmeTiffFile, path, pixel_um=0.74)
    with tifffile.TiffFile(path) as tiff:
        assert tiff.is_ome
        [series] = tiff.series
        assert (series.axes, series.shape) == ("TCYX", (5, 7, 13, 17))
        data = series.asarray()
        ome = ET.fromstring(tiff.ome_metadata)
        tags = tiff.pages[0].tags
    assert data.dtype == np.float32
    for axis in "XY":       # per cm: what ImageJ takes a pixel size from
        above, below = tags[f"{axis}Resolution"].value
        assert below / above * 1e4 == pytest.approx(0.74, rel=2e-6)
    assert tags["ResolutionUnit"].value == 3
    for c, name in enumerate(NAMES):
        np.testing.assert_array_equal(data[:, c], expected(name, 5))
    space = {"o": "http://www.openmicroscopy.org/Schemas/OME/2016-06"}
    pixels = ome.find(".//o:Pixels", space)
    assert [c.get("Name") for c in pixels.findall("o:Channel", space)] == list(NAMES)
    assert float(pixels.get("PhysicalSizeX")) == 0.74
    assert pixels.get("PhysicalSizeXUnit") == "\N{MICRO SIGN}m"
    assert float(pixels.get("TimeIncrement")) == 0.005
    planes = pixels.findall("o:Plane", space)
    assert len(planes) == 35
    for p in planes:
        assert float(p.get("DeltaT")) == pytest.approx(0.005 * int(p.get("TheT")))
    facts = json.loads(ome.find(".//o:CommentAnnotation/o:Value", space).text)
    assert facts["parameters"] == {"cutoff_hz": 1.6}
    assert facts["label"] == FACTS["label"]
    assert facts["first_t_us"] == 1_000_000
    assert facts["units"]["aop"] == "rad"


def test_the_ome_xml_is_of_the_published_schema(tmp_path):
    """What Bio-Formats, and so Fiji and QuPath, parse (needs ome-types and lxml)."""
    tifffile = pytest.importorskip("tifffile")
    ome_types = pytest.importorskip("ome_types")
    path = tmp_path / "stack.ome.tif"
    write(OmeTiffFile, path, pixel_um=0.74)
    with tifffile.TiffFile(path) as tiff:
        told = tiff.ome_metadata
    ome_types.validate_xml(told)
    pixels = ome_types.from_xml(told).images[0].pixels
    assert [channel.name for channel in pixels.channels] == list(NAMES)
    assert (pixels.size_t, pixels.physical_size_x) == (5, 0.74)
    with pytest.raises(ValueError, match="SizeT"):
        ome_types.validate_xml(told.replace('SizeT="5"', 'SizeT="five"'))


def test_a_big_tiff_reads_the_same(tmp_path, monkeypatch):
    tifffile = pytest.importorskip("tifffile")
    monkeypatch.setattr("pdavis_cv.export.ometiff._CLASSIC_END", 1000)
    write(OmeTiffFile, tmp_path / "big.ome.tif", 3)
    with tifffile.TiffFile(tmp_path / "big.ome.tif") as tiff:
        assert tiff.is_bigtiff
        assert tiff.series[0].axes == "TCYX"
        np.testing.assert_array_equal(tiff.asarray()[:, 4], expected("s0", 3))


def test_opencv_reads_the_planes_of_the_tiff(tmp_path):
    cv2 = pytest.importorskip("cv2")
    write(OmeTiffFile, tmp_path / "stack.ome.tif", 2)
    found, planes = cv2.imreadmulti(
        str(tmp_path / "stack.ome.tif"), flags=cv2.IMREAD_UNCHANGED)
    assert found
    np.testing.assert_array_equal(planes[4], expected("s0", 2)[0])


def test_hdf5_returns_numbers_units_and_provenance(tmp_path):
    h5py = pytest.importorskip("h5py")
    write(Hdf5File, tmp_path / "stack.h5", pixel_um=0.74)
    with h5py.File(tmp_path / "stack.h5") as file:
        for name in NAMES:
            np.testing.assert_array_equal(file[name][:], expected(name, 5))
        assert file["aop"].attrs["units"] == "rad"
        np.testing.assert_array_equal(file["t_us"], 1_000_000 + 5000 * np.arange(5))
        assert json.loads(file.attrs["provenance"])["method"] == "cf"
        assert file.attrs["pixel_um"] == 0.74


@pytest.mark.parametrize(("pixel_um", "unit"), [(None, "pixel"), (0.74, "um")])
def test_xarray_opens_the_hdf5_with_named_dimensions(tmp_path, pixel_um, unit):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    write(Hdf5File, tmp_path / "stack.h5", pixel_um=pixel_um)
    with xarray.open_dataset(tmp_path / "stack.h5", engine="h5netcdf") as data:
        assert data["aop"].dims == ("t_us", "y", "x")
        np.testing.assert_array_equal(data["aop"], expected("aop", 5))
        np.testing.assert_array_equal(
            data["t_us"], 1_000_000 + 5000 * np.arange(5))
        np.testing.assert_allclose(
            data["x"], (pixel_um or 1) * np.arange(data.sizes["x"]))
        assert (data["aop"].units, data["x"].units) == ("rad", unit)


def test_images_become_an_xarray_dataset():
    pytest.importorskip("xarray")
    some = list(images(3))
    data = to_xarray(iter(some), ["aop", "s0"])
    assert list(data) == ["aop", "s0"]
    np.testing.assert_array_equal(data["aop"], expected("aop", 3))
    assert data["t_us"].values.tolist() == [image.t_us for image in some]
    assert data["aop"].units == "rad"
    assert json.loads(data.provenance) == dict(some[0].provenance)
    assert to_xarray(some[1])["s0"].shape == (1, *some[1].shape)
    later = data.swap_dims(t_us="time")
    assert list(later["time"].values.astype("timedelta64[us]").astype(int)) == [
        image.t_us for image in some]
    assert later.resample(time="1h").mean()["s0"].shape == (1, *some[1].shape)
    with pytest.raises(ValueError, match="quantity must be one of"):
        to_xarray(some, ["angle"])
    with pytest.raises(ValueError, match="at least one, got none"):
        to_xarray([])
    with pytest.raises(ValueError, match="images must have one shape"):
        to_xarray([some[0], PolarFrame(np.ones((4, 2, 2)))])


def test_npz_returns_numbers_times_and_provenance(tmp_path):
    write(NpzFile, tmp_path / "stack.npz")
    with np.load(tmp_path / "stack.npz") as file:
        for name in NAMES:
            np.testing.assert_array_equal(file[name], expected(name, 5))
        np.testing.assert_array_equal(file["t_us"], 1_000_000 + 5000 * np.arange(5))
        assert json.loads(str(file["provenance"]))["label"] == FACTS["label"]


KINDS = [(OmeTiffFile, "a.ome.tif"), (Hdf5File, "a.h5"), (NpzFile, "a.npz"),
         (NpyFile, "a.npy"), (OmeZarrFile, "a.ome.zarr")]


@pytest.mark.parametrize(("kind", "name"), KINDS)
def test_an_error_leaves_nothing(tmp_path, kind, name):
    def fail():
        with kind(tmp_path / name, NAMES, FACTS) as file:
            file.add(next(images(1)))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("kind", "name"), KINDS)
def test_an_interrupted_stack_continues_to_the_same_numbers(tmp_path, kind, name):
    stop, whole = tmp_path / name, tmp_path / f"whole-{name}"
    write(kind, whole, 6)

    def begin():
        with kind(stop, NAMES, FACTS, resume=True) as file:
            for frame in list(images(6))[:4]:
                file.add(frame)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        begin()
    assert not stop.exists()
    # What was killed inside an image is dropped to the last whole one.
    part = tmp_path / f".{name}.unfinished"
    os.truncate(part, part.stat().st_size - 100)
    with kind(stop, NAMES, FACTS, resume=True) as file:
        assert file.count == 3
        for frame in list(images(6))[3:]:
            file.add(frame)
    beside = [f"{name}.json", f"whole-{name}.json"] if kind is NpyFile else []
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        [name, f"whole-{name}", *beside])
    a, b = _numbers(stop), _numbers(whole)
    assert a.keys() == b.keys()
    for key in a:
        np.testing.assert_array_equal(a[key], b[key])


def _numbers(path):
    if path.suffix == ".npy":
        return {"all": np.load(path)}
    if path.suffix == ".npz":
        with np.load(path) as file:
            return {key: file[key] for key in file.files}
    if path.suffix == ".h5":
        h5py = pytest.importorskip("h5py")
        with h5py.File(path) as file:
            return {key: file[key][:] for key in file}
    if path.suffix == ".zarr":
        group = pytest.importorskip("zarr").open_group(path, mode="r")
        return {key: array[:] for key, array in group.arrays()}
    return {"all": pytest.importorskip("tifffile").imread(path)}


def test_other_facts_start_again(tmp_path):
    def begin():
        with NpzFile(tmp_path / "a.npz", NAMES, FACTS, resume=True) as file:
            file.add(next(images(1)))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        begin()
    with NpzFile(tmp_path / "a.npz", NAMES, {"method": "frames"}, resume=True) as file:
        assert file.count == 0
        for frame in images(2):
            file.add(frame)


FULL = """
import os, resource, sys
import numpy as np
from pdavis_cv import PolarFrame, export
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
kind, path = getattr(export, sys.argv[1]), sys.argv[2]
for count in sys.argv[3:]:
    try:
        with kind(path, ("s0",)) as file:
            for k in range(int(count)):
                file.add(PolarFrame(np.ones((4, 100, 100)), t_us=k))
    except OSError as error:
        print("refused:", error, os.listdir(os.path.dirname(path)))
"""


@pytest.mark.parametrize(("kind", "name"), KINDS)
def test_a_full_disk_is_an_error_and_leaves_nothing(tmp_path, kind, name):
    counts = ["5", "6", "40"]   # full while it is completed, before that, on the way
    if kind in (OmeTiffFile, OmeZarrFile):
        del counts[0]           # compressed, or in files of a plane each, it fits
    path = str(tmp_path / name)
    done = subprocess.run(
        [sys.executable, "-P", "-c", FULL, kind.__name__, path, *counts],
        capture_output=True, text=True, check=True)
    said = done.stdout.splitlines()
    assert len(said) == len(counts)
    for line in said:
        assert line.startswith("refused:")
        assert path in line
        assert line.endswith(" []")     # what is left
    assert "Traceback" not in done.stderr   # packages may warn of each other


@pytest.mark.parametrize(("kind", "name"), KINDS)
def test_a_folder_that_is_not_there_is_an_error(tmp_path, kind, name):
    with pytest.raises(FileNotFoundError):
        kind(tmp_path / "none" / name)


def test_unfit_images_and_names_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"one of i0, .* got 'colour'"):
        NpzFile(tmp_path / "a.npz", ["colour"])
    with pytest.raises(ValueError, match="pixel_um must be positive"):
        NpzFile(tmp_path / "a.npz", pixel_um=0)
    with pytest.raises(ValueError, match="no image to write"), NpzFile(
            tmp_path / "a.npz"):
        pass
    frame = next(images(1))
    with NpzFile(tmp_path / "b.npz", ["s0"]) as file:
        with pytest.raises(ValueError, match="frame must have a time"):
            file.add(PolarFrame(frame.quad))
        file.add(frame)
        with pytest.raises(ValueError, match="frame must be later than"):
            file.add(frame)
        with pytest.raises(ValueError, match="first one's shape"):
            file.add(PolarFrame(np.ones((4, 3, 3)), t_us=9_000_000))
    with pytest.raises(ValueError, match="needs a method that knows its variance"):
        quantity("sigma_aop").of(frame)


def test_provenance_names_the_input_and_shortens_maps(tmp_path):
    source = tmp_path / "run.csv"
    source.write_bytes(b"1 2 3 1\n")
    facts = provenance({"method": "cf", "parameters": {"theta": np.ones((4, 90))}},
                       open_recording(source), wrong=float("nan"))
    assert facts["input"] == {
        "name": "run.csv", "bytes": 8,
        "sha256": hashlib.sha256(source.read_bytes()).hexdigest()}
    assert facts["parameters"]["theta"]["shape"] == [4, 90]
    assert json.loads(json.dumps(facts, allow_nan=False))["wrong"] == "nan"


def test_a_killed_export_leaves_no_file_under_its_name(tmp_path):
    code = ("import sys, numpy as np; from pdavis_cv import PolarFrame, export\n"
            "f = export.OmeTiffFile(sys.argv[1], resume=True)\n"
            "for k in range(3): f.add(PolarFrame(np.ones((4, 64, 64)), t_us=k))\n"
            "import os, signal; os.kill(os.getpid(), signal.SIGKILL)")
    path = tmp_path / "a.ome.tif"
    done = subprocess.run([sys.executable, "-P", "-c", code, str(path)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert not path.exists()
    with OmeTiffFile(path, resume=True) as file:
        before = file.count  # what the system had not yet been given is lost
        assert 0 <= before <= 3
        for k in range(before, 5):
            file.add(PolarFrame(np.ones((4, 64, 64)), t_us=k))
    assert [p.name for p in tmp_path.iterdir()] == ["a.ome.tif"]
