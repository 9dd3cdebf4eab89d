"""OME-Zarr as other programs open it; interruptions are in test_stacks."""
import json

import numpy as np
import pytest
from test_stacks import FACTS, NAMES, expected, images, write

from pdavis_cv.data import example_recording
from pdavis_cv.export import OmeZarrFile
from pdavis_cv.tools.export import main

zarr = pytest.importorskip("zarr")
SHAPE = (260, 346)


@pytest.fixture
def store(tmp_path):
    path = tmp_path / "stack.ome.zarr"
    with OmeZarrFile(path, NAMES, FACTS, pixel_um=0.74) as file:
        for frame in images(3, SHAPE):
            file.add(frame)
    return path


def planes(names=NAMES):
    from pdavis_cv.quantities import quantity
    return np.stack([[np.where(one.valid, quantity(name).of(one), np.nan)
                      for name in names] for one in images(3, SHAPE)])


def test_levels_chunks_units_and_channels(store):
    group = zarr.open_group(store, mode="r")
    whole = planes()
    for level, step in enumerate((1, 2, 4)):
        array = group[str(level)]
        assert array.chunks == (1, 1, *array.shape[2:])
        assert array.metadata.dimension_names == ("t", "c", "y", "x")
        np.testing.assert_array_equal(array[:], whole[:, :, ::step, ::step])
    assert len(list(group.arrays())) == 3
    ome, ours = group.attrs["ome"], group.attrs["pdavis_cv"]
    [scales] = ome["multiscales"]
    assert [axis.get("unit") for axis in scales["axes"]] == [
        "second", None, "micrometer", "micrometer"]
    assert [one["coordinateTransformations"][0]["scale"] for one in scales["datasets"]
            ] == [[0.005, 1, step * 0.74, step * 0.74] for step in (1, 2, 4)]
    assert [one["label"] for one in ome["omero"]["channels"]] == list(NAMES)
    assert ours["t_us"] == [1_000_000, 1_005_000, 1_010_000]
    assert ours["units"]["aop"] == "rad"
    assert ours["provenance"]["label"] == FACTS["label"]


def test_ome_zarr_reads_it(store):
    reader = pytest.importorskip("ome_zarr.reader")
    from ome_zarr.io import parse_url
    [node, *_] = reader.Reader(parse_url(store))()
    assert [axis["name"] for axis in node.metadata["axes"]] == list("tcyx")
    assert len(node.data) == 3
    np.testing.assert_array_equal(np.asarray(node.data[0]), planes())
    assert node.metadata["channel_names"] == list(NAMES)


def test_bioio_reads_it(store):
    module = pytest.importorskip("bioio_ome_zarr")
    image = module.Reader(str(store))
    assert image.channel_names == list(NAMES)
    assert image.dims.order.endswith("TCYX") or image.dims.order == "TCYX"
    np.testing.assert_array_equal(np.squeeze(image.data), planes())
    assert (image.physical_pixel_sizes.Y, image.physical_pixel_sizes.X) == (0.74, 0.74)


def test_xarray_opens_each_level(store):
    xarray = pytest.importorskip("xarray")
    with xarray.open_zarr(store, drop_variables=["1", "2"], consolidated=False) as data:
        assert data["0"].dims == ("t", "c", "y", "x")
        np.testing.assert_array_equal(data["0"], planes())


def test_a_small_stack_has_one_level(tmp_path):
    write(OmeZarrFile, tmp_path / "a.ome.zarr")
    group = zarr.open_group(tmp_path / "a.ome.zarr", mode="r")
    assert list(group) == ["0"]
    for c, name in enumerate(NAMES):
        np.testing.assert_array_equal(group["0"][:, c], expected(name, 5))


def test_export_writes_it_and_refuses_a_folder_that_is_there(tmp_path, capsys):
    out = tmp_path / "fused.ome.zarr"
    arguments = [str(example_recording("fan")), "-o", str(out), "--fps", "20", "--json",
                 "--method", "cf"]
    assert main([*arguments, "--resume"]) == 0
    told = json.loads(capsys.readouterr().out)
    group = zarr.open_group(out, mode="r")
    assert list(group["0"].shape) == told["shape"]
    assert main(arguments) == 2
    assert "Is a directory" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["fused.ome.zarr"]
