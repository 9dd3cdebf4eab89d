"""The reader for napari, through its plugin engine and without a window."""
import inspect
import math
import warnings

import numpy as np
import pytest

import pdavis_cv
from pdavis_cv import adapters
from pdavis_cv.adapters import napari_plugin
from pdavis_cv.data import example_recording
from pdavis_cv.export import OmeTiffFile
from pdavis_cv.simulation import Camera, RotatingPolarizer

pytest.importorskip("tifffile")


@pytest.fixture(scope="module")
def recording():
    camera = Camera.preset("ideal", size=(8, 10))
    return camera.record(RotatingPolarizer(rpm=30), 0.3)[0]


@pytest.fixture(scope="module")
def stack(recording, tmp_path_factory):
    path = tmp_path_factory.mktemp("napari") / "a.ome.tif"
    with OmeTiffFile(path, ("s0", "aop", "dolp"), pixel_um=0.5,
                     facts={"method": "frames"}) as file:
        for image in pdavis_cv.fuse(recording, fps=50, method="frames"):
            file.add(image)
    return path


def read(path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")     # its own, of pydantic
        npe2 = pytest.importorskip("npe2")
    manifest = npe2.PluginManifest.from_file(
        str(next(iter(adapters.__path__))) + "/napari.yaml")
    engine = npe2.PluginManager.instance()
    if manifest.name not in engine:
        engine.register(manifest)
    return npe2.read([str(path)], plugin_name=manifest.name, stack=False)


def test_an_exported_stack_is_three_named_scaled_layers(stack):
    layers = read(stack)
    assert [kind for _, _, kind in layers] == ["image"] * 3
    assert [facts["name"] for _, facts, _ in layers] == ["s0", "aop", "dolp"]
    for data, facts, _ in layers:
        assert data.shape[1:] == (8, 10)
        assert facts["scale"] == (0.02, 0.5, 0.5)
        assert facts["units"] == ("s", "um", "um")
        assert facts["axis_labels"] == ("t", "y", "x")
    limits = [facts["contrast_limits"] for _, facts, _ in layers]
    assert limits[1:] == [(0.0, math.pi), (0.0, 1.0)]
    assert 0 == limits[0][0] < 25 < limits[0][1] < 40
    assert layers[1][1]["metadata"]["method"] == "frames"


def test_a_recording_is_fused_into_three_layers(tmp_path, recording):
    path = tmp_path / "a.aedat4"
    pdavis_cv.write_aedat4(path, recording)
    layers = read(path)
    assert [facts["name"] for _, facts, _ in layers] == ["s0", "aop", "dolp"]
    assert {data.dtype for data, _, _ in layers} == {np.dtype(np.float32)}
    assert layers[0][1]["scale"][0] == pytest.approx(0.05, abs=1e-3)


def test_the_sample_recordings_are_offered(tmp_path):
    npe2 = pytest.importorskip("npe2")
    manifest = npe2.PluginManifest.from_file(
        str(next(iter(adapters.__path__))) + "/napari.yaml")
    offered = {one.key: one.command for one in manifest.contributions.sample_data}
    assert set(offered) == {"fan", "tendon"}
    made = {command.id: command.python_name.rpartition(":")[2]
            for command in manifest.contributions.commands}
    layers = getattr(napari_plugin, made[offered["tendon"]])()
    assert [facts["name"] for _, facts, _ in layers] == ["s0", "aop", "dolp"]
    assert layers[0][0].shape[1:] == (64, 96)
    assert [facts["units"] for _, facts, _ in layers] == [("s", "pixel", "pixel")] * 3


@pytest.mark.filterwarnings("ignore::DeprecationWarning")   # napari's own
def test_napari_takes_the_layers():
    napari = pytest.importorskip("napari")
    for data, facts, kind in napari_plugin.fan():
        layer = napari.layers.Layer.create(data, facts, kind)
        assert layer.axis_labels == ("t", "y", "x")
        assert [f"{unit:D}" for unit in layer.units] == ["second", "pixel", "pixel"]


def test_the_widget_fuses_a_part_of_a_recording(tmp_path, recording):
    path = tmp_path / "a.aedat4"
    pdavis_cv.write_aedat4(path, recording)
    read(path)      # registers the plugin
    npe2 = pytest.importorskip("npe2")
    manager = npe2.PluginManager.instance()
    [widget] = manager.get_manifest("pdavis-cv").contributions.widgets
    assert widget.autogenerate
    # magicgui cannot resolve strings that name what is in our module
    for name, one in (("method", "kalman"), ("layout", "pdavis")):
        asked = inspect.signature(napari_plugin.fuse_recording).parameters[name]
        assert one in asked.annotation.__metadata__[0]["choices"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fused = manager.commands.execute(widget.command, (
            path, "cf", 100.0, 0.05, 0.2))
    assert [facts["name"] for _, facts, _ in fused] == ["s0", "aop", "dolp"]
    assert fused[1][0].shape == (20, 8, 10)
    assert fused[0][1]["metadata"]["method"] == "cf"
    with pytest.raises(ValueError, match="the recording's clock"):
        napari_plugin.fuse_recording(path, start_s=9.0)


def test_a_foreign_tiff_is_left_to_others(tmp_path):
    import tifffile
    tifffile.imwrite(tmp_path / "b.ome.tif", np.zeros((4, 4), np.uint8))
    assert napari_plugin.get_reader(str(tmp_path / "b.ome.tif")) is None
    assert napari_plugin.get_reader(str(example_recording("fan"))) is not None
