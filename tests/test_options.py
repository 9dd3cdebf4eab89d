"""FusionOptions: one list that fuse, VideoCapture and every command are made from."""
import argparse
import dataclasses
import inspect
import pickle
import typing

import numpy as np
import pytest
from ideal import rotating_polarizer

import pdavis_cv
from pdavis_cv import Calibration, FusionOptions, Layout, VideoCapture, fuse
from pdavis_cv.capture.video import CaptureKeywords
from pdavis_cv.data import example_recording
from pdavis_cv.fusion.options import AllKeywords, FusionKeywords
from pdavis_cv.live import Session
from pdavis_cv.reconstruct.methods import MethodKeywords, method_parameters
from pdavis_cv.recording.options import SourceKeywords, SourceOptions
from pdavis_cv.tools import _flags, _options, export, fan

OPTIONS = sorted(FusionOptions.facts())


@pytest.fixture(scope="module")
def recording():
    return rotating_polarizer(202.6, 0.3, size=(8, 8))[0]


def test_every_field_is_an_option_or_the_method_s():
    names = {field.name for field in dataclasses.fields(FusionOptions)}
    assert names - set(OPTIONS) == {"parameters"}


@pytest.mark.parametrize("name", OPTIONS)
def test_an_option_is_a_keyword_of_fuse_and_of_videocapture(name):
    default = next(field.default for field in dataclasses.fields(FusionOptions)
                   if field.name == name)
    facts = FusionOptions.facts()[name]
    for function in (fuse, VideoCapture):
        parameter = inspect.signature(function).parameters[name]
        assert parameter.kind is inspect.Parameter.KEYWORD_ONLY
        assert parameter.default == default
        assert f"{name} : {facts.type}" in inspect.getdoc(function)
    with VideoCapture(example_recording(), layout=Layout.PDAVIS,
                      **({} if name == "layout" else {name: default})) as capture:
        assert capture.isOpened()


def told_of(*keywords):
    return {name: told.__forward_arg__ for one in keywords
            for name, told in one.__annotations__.items()}


def offered_to_type_checkers(taker):
    return [list(overload.__annotations__.values())[-2]     # the last is of the return
            for overload in typing.get_overloads(taker.__init__)]


def test_type_checkers_see_the_options_of_a_class():
    for options, keywords, more in ((FusionOptions, FusionKeywords, MethodKeywords),
                                    (SourceOptions, SourceKeywords, {})):
        types = {field.name: field.type for field in dataclasses.fields(options)}
        told = {name: kind for name, kind in told_of(keywords).items()
                if name not in getattr(more, "__annotations__", {})}
        assert told == {name: types[name] for name in ("parameters", *options.facts())}
    assert told_of(AllKeywords) == told_of(SourceKeywords, FusionKeywords)
    assert offered_to_type_checkers(Session) == ["Unpack[AllKeywords]", "Any"]


def test_type_checkers_see_the_parameters_of_every_method():
    methods = ("frames", "events", "cf", "kalman", "firenet", "joint")
    assert set(MethodKeywords.__annotations__) == {
        name for method in methods for name in method_parameters(method)}


def test_type_checkers_see_the_keywords_of_videocapture():
    given = {name: told for name, told in told_of(CaptureKeywords).items()
             if name not in told_of(AllKeywords)}
    own = VideoCapture.__init__
    assert given == {name: own.__annotations__[name] for name in own.__kwdefaults__}
    assert offered_to_type_checkers(VideoCapture) == ["Unpack[CaptureKeywords]", "Any"]


@pytest.mark.parametrize("name", OPTIONS)
def test_an_option_is_one_of_every_command(name):
    parser = argparse.ArgumentParser()
    _options.add_fuse_options(parser)
    shown = parser.format_help()
    offered = FusionOptions.facts()[name].word is not None
    flag = _flags.flag_of(name, FusionOptions.facts()[name])
    assert (f"{flag} " in shown) == offered
    # An array fits no command line; an analyser has flags for its parts.
    assert offered or name in ("times_us", "analyser")


def test_a_new_field_reaches_signature_help_and_commands(monkeypatch):
    facts = dict(FusionOptions.facts())
    facts["frobnicate"] = facts["fps"]._replace(help="How often.", brief="how often")
    monkeypatch.setattr(FusionOptions, "facts", classmethod(lambda cls: facts))
    parser = argparse.ArgumentParser()
    _options.add_fuse_options(parser)
    assert parser.parse_args(["--frobnicate", "5"]).frobnicate == 5.0
    assert "how often" in parser.format_help()


def test_options_begin_and_keywords_change_them(recording):
    options = FusionOptions(method="cf", fps=50, parameters={"cutoff_hz": 3.0})
    images = list(fuse(recording, options, fps=100, adaptive_gain=False))
    facts = images[0].provenance["parameters"]
    assert (facts["cutoff_hz"], facts["adaptive_gain"]) == (3.0, False)
    assert images[1].t_us - images[0].t_us == 10_000
    assert options.fps == 50
    assert options.parameters == {"cutoff_hz": 3.0}


def test_options_are_frozen_and_pickle():
    options = FusionOptions(roi=[0, 0, 4, 2], times_us=[1, 5], layout=Layout.SONY,
                            thresholds=(0.1, np.ones((2, 2))))
    with pytest.raises(dataclasses.FrozenInstanceError):
        options.fps = 3
    again = pickle.loads(pickle.dumps(options.replace(hold="mid")))
    assert (again.roi, again.layout) == ((0, 0, 4, 2), Layout.SONY)
    assert again.parameters["hold"] == "mid"
    np.testing.assert_array_equal(again.times_us, [1, 5])


@pytest.mark.parametrize(("changes", "error", "message"), [
    ({"fps": -1}, ValueError, "fps must lie in"),
    ({"roi": "all"}, TypeError, "roi must be four integers"),
    ({"denoise": 1}, TypeError, "denoise must be a bool or a mapping"),
    ({"calibration": "camera.npz"}, TypeError, "calibration must be a Calibration"),
    ({"extinction_ratio": "best"}, ValueError, "must be 'nominal', a number or None"),
    ({"thresholds": "best"}, ValueError, "thresholds must be 'calibration', 'bias'"),
    ({"method": "best"}, ValueError, "method must be one of"),
    ({"stop_us": 0.5}, TypeError, "stop_us must be integer microseconds"),
])
def test_options_are_checked_without_a_recording(changes, error, message):
    with pytest.raises(error, match=message):
        FusionOptions(**changes)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A recording of a camera whose thresholds a calibration knows."""
    folder = tmp_path_factory.mktemp("calibrated")
    made, _ = rotating_polarizer(202.6, 2.5, size=(16, 16), theta=(0.17, 0.17))
    path = folder / "run.aedat4"
    pdavis_cv.write_aedat4(path, made)
    plane = np.full((16, 16), 0.17, np.float32)
    known = Calibration(sensor_size=(16, 16), theta_on=plane, theta_off=plane,
                        layout=Layout.PDAVIS)
    return path, known.save(folder / "camera.npz")


def test_a_calibration_reaches_export(calibrated, tmp_path):
    path, camera = calibrated
    out = tmp_path / "a.npy"
    assert export.main([str(path), "-o", str(out), "--calibration", str(camera),
                        "--thresholds", "calibration", "--method", "cf", "--fps",
                        "100", "--extinction-ratio", "none", "--stop", ".3"]) == 0
    with pdavis_cv.open_recording(path) as recording:
        images = list(fuse(recording, method="cf", fps=100, thresholds=(0.17, 0.17),
                           layout=Layout.PDAVIS, extinction_ratio=None,
                           stop_us=recording.info.start_us + 300_000))
    np.testing.assert_array_equal(
        np.load(out)[:, 2], [image.dolp for image in images])


def test_a_calibration_that_is_missing_or_of_another_camera_is_one_line(
        calibrated, tmp_path, capsys):
    path, _ = calibrated
    for main in (export.main, fan.main):
        assert main([str(path), "-o", str(tmp_path / "a.mp4"),
                     "--calibration", str(tmp_path / "none.npz")]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    other = Calibration(sensor_size=(4, 4)).save(tmp_path / "other.npz")
    assert export.main([str(path), "-o", str(tmp_path / "a.npy"),
                        "--calibration", str(other)]) == 2
    assert "sensor" in capsys.readouterr().err
