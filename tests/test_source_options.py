"""SourceOptions: what a caller may state about a source, and where facts come from."""
import argparse
import dataclasses
import inspect
import pickle

import numpy as np
import pytest
from test_aedat4_writer import small

import pdavis_cv
from pdavis_cv import Layout, Limits, Sensor, VideoCapture, open_recording, open_source
from pdavis_cv.live.base import restated
from pdavis_cv.recording.facts import Fact
from pdavis_cv.recording.hdf5.writer import write_hdf5
from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.tools import _options

OPTIONS = sorted(SourceOptions.facts())


@pytest.mark.parametrize("name", OPTIONS)
def test_an_option_is_one_of_every_function_and_command(name):
    default = next(field.default for field in dataclasses.fields(SourceOptions)
                   if field.name == name)
    for function in (open_recording, open_source, VideoCapture):
        parameter = inspect.signature(function).parameters[name]
        assert parameter.kind is inspect.Parameter.KEYWORD_ONLY
        assert parameter.default == default
        assert f"{name} : {SourceOptions.facts()[name].type}" in inspect.getdoc(
            function) or name == "layout"
    for add in (_options.add_source_options, _options.add_fuse_options):
        parser = argparse.ArgumentParser()
        add(parser)
        assert "--" + name.replace("_", "-") in parser.format_help()


def test_options_of_the_command_line_are_those_of_python():
    parser = argparse.ArgumentParser()
    _options.add_source_options(parser)
    given = _options.source_given(parser.parse_args([
        "--layout", "sony", "--sensor-size", "346x260", "--source-fps", "50",
        "--exposure-us", "5000", "--bits", "10", "--camera", "left", "--limits",
        "memory=1e9,ratio=7"]))
    assert given == {"layout": Layout.SONY, "sensor_size": (260, 346),
                     "source_fps": 50.0, "exposure_us": 5000, "bits": 10,
                     "camera": "left", "limits": Limits(memory=1e9, ratio=7)}
    assert SourceOptions(**given).known_full_scale_dn == 1023


@pytest.mark.parametrize(("wrong", "error", "message"), [
    ({"source_fps": 0}, ValueError, "source_fps must lie in"),
    ({"sensor_size": 346}, ValueError, "sensor_size must be"),
    ({"bits": 40}, ValueError, "bits must be a whole number of 1..32"),
    ({"bits": 10, "full_scale_dn": 1023}, ValueError, "bits or full_scale_dn"),
    ({"sensor": "leica"}, ValueError, "sensor must be one of pdavis, sony"),
    ({"camera": 3}, TypeError, "camera must be a str"),
    ({"bad_events": "keep"}, ValueError, "bad_events must be one of drop, raise"),
    ({"exposure_us": -1}, ValueError, "exposure_us must be a whole number"),
])
def test_options_are_checked_without_a_source(wrong, error, message):
    with pytest.raises(error, match=message):
        SourceOptions(**wrong)


def test_options_pickle():
    options = SourceOptions(layout="sony", sensor_size=[4, 6]).replace(side=3)
    again = pickle.loads(pickle.dumps(options))
    assert (again.layout, again.layout.owner) == (Layout.SONY, "sony")
    assert (again.sensor_size, again.parameters["side"]) == ((4, 6), 3)


def test_a_named_layout_states_its_sensor_and_one_of_angles_does_not():
    assert Layout.of("sony").sensor is Sensor.SONY
    assert Layout.SONY.crop(1, 0).flip_y().sensor is Sensor.SONY
    assert Layout.of("90,45,135,0").sensor is None
    assert Layout.of("90,45,135,0") == Layout.SONY
    assert SourceOptions(sensor="pdavis").known_layout == Layout.PDAVIS


@pytest.fixture
def file(tmp_path):
    """Write a recording whose camera and layout are not known."""
    path = tmp_path / "run.aedat4"
    pdavis_cv.write_aedat4(path, small())
    return path


def test_facts_say_where_they_come_from(file):
    with open_recording(file) as recording:
        assert recording.info.facts == {
            "sensor_size": Fact(recording.info.sensor_size, "file"),
            "frame_times": Fact("time stamps", "file"),
            "full_scale_dn": Fact(1023, "file")}
    with open_recording(file, layout="pdavis") as recording:
        facts = recording.info.facts
        assert facts["layout"] == Fact(Layout.PDAVIS, "caller")
        assert facts["sensor"] == Fact(Sensor.PDAVIS, "caller")
        assert facts["extinction_ratio"] == Fact(40.0, "caller")
    with open_recording(file, layout="135,90,0,45") as recording:
        assert recording.info.facts.keys() & {"sensor", "extinction_ratio"} == set()


def test_our_files_keep_the_owner_of_a_layout(tmp_path):
    for name, write in (("x.aedat4", pdavis_cv.write_aedat4),
                        ("x.h5", write_hdf5)):
        for layout in (Layout.PDAVIS, Layout.of("135,90,0,45")):
            write(tmp_path / name, small(layout=layout))
            with open_recording(tmp_path / name) as recording:
                assert recording.info.layout == layout
                assert recording.info.sensor is layout.sensor
                origin = recording.info.facts.get("sensor", Fact(None, "file")).origin
                assert origin == "file"


def test_a_size_that_contradicts_the_file_is_refused(file):
    with pytest.raises(ValueError, match="sensor_size says 4x6, the file 16x12"):
        open_recording(file, sensor_size=(6, 4))


def test_an_assumed_size_is_said_to_be_assumed(tmp_path):
    path = tmp_path / "events.txt"
    path.write_text("".join(f"{k} {k} 3 1\n" for k in range(20)))
    with open_recording(path) as recording:
        assert recording.info.facts["sensor_size"] == Fact((260, 346), "assumed")
    with open_recording(path, sensor="dvs128") as recording:
        assert recording.info.sensor_size == (128, 128)
        assert recording.info.facts["sensor"] == Fact(Sensor.DVS128, "caller")
    with open_recording(path, sensor_size=(4, 30)) as recording:
        assert recording.info.facts["sensor_size"] == Fact((4, 30), "caller")


def test_a_chip_of_the_file_is_not_another_sensor_s():
    info = dataclasses.replace(small().info, sensor=Sensor.DAVIS346)
    assert restated(info, SourceOptions(layout="sony")).sensor is Sensor.DAVIS346
    assert restated(info, SourceOptions(layout="pdavis")).sensor is Sensor.PDAVIS
    assert restated(info, SourceOptions(sensor="sony")).sensor is Sensor.SONY


def test_no_extinction_ratio_is_corrected_that_nobody_stated(file):
    def ratio(**options):
        with open_recording(file, **options) as recording:
            return next(pdavis_cv.fuse(recording)).extinction_ratio

    assert ratio(layout="pdavis") == 40.0
    assert ratio(layout="135,90,0,45") is None
    with pytest.warns(pdavis_cv.LayoutWarning):
        assert ratio() is None
    with open_recording(file) as recording:
        image = next(pdavis_cv.fuse(recording, layout="sony"))
        assert image.extinction_ratio == 350.0


def test_the_rate_of_a_source_is_not_that_of_the_output(tmp_path):
    cv2 = pytest.importorskip("cv2")
    for k in range(4):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((4, 4), k, np.uint16))
    source = str(tmp_path / "%d.png")
    with open_recording(source, layout="sony") as recording:
        assert recording.info.facts["frame_times"] == Fact(25.0, "assumed")
    with open_recording(source, layout="sony", source_fps=10, bits=10) as recording:
        assert recording.info.facts["frame_times"] == Fact(10.0, "caller")
        frames = [packet.frames[0] for packet in recording.packets()]
        assert [frame.mid_us for frame in frames] == [0, 100_000, 200_000, 300_000]
        assert frames[0].full_scale_dn == 1023
    with VideoCapture(source, layout="sony", source_fps=10, fps=20) as capture:
        assert capture.get(cv2.CAP_PROP_FPS) == 20
        assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == 7
    several = [str(tmp_path / f"{k}.png") for k in (2, 0)]
    with open_recording(several, layout="sony") as recording:
        assert [packet.frames[0].dn[0, 0] for packet in recording.packets()] == [2, 0]
