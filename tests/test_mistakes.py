"""Mistakes of new users are answered by what to do instead."""
import re

import numpy as np
import pytest
from streams import random_events

import pdavis_cv
from pdavis_cv import render
from pdavis_cv._advice import ADVICE
from pdavis_cv.data import example_recording
from pdavis_cv.fusion.iteration import ReadAhead
from pdavis_cv.registry import instead
from pdavis_cv.tools.main import main

TENDON = example_recording("tendon")


@pytest.fixture(scope="module")
def image():
    with pdavis_cv.open_recording(TENDON) as recording:
        return next(iter(pdavis_cv.fuse(recording, fps=10)))


@pytest.mark.parametrize(("name", "said"), [
    ("aolp", "it is aop"), ("AoP", "it is aop"), ("dop", "it is dolp"),
    ("DoLP", "it is dolp"), ("intensity", "it is s0"), ("I45", "planes of quad"),
    ("validd", "did you mean valid")])
def test_an_image_says_what_an_attribute_is_called(image, name, said):
    with pytest.raises(AttributeError, match=f"no '{name}'; .*{said}"):
        getattr(image, name)


def test_a_private_attribute_that_there_is_not_gets_no_advice(image):
    with pytest.raises(AttributeError, match=r"no '_repr_html_'$"):
        _ = image._repr_html_


@pytest.mark.parametrize("colour", [
    render.aop_bgr, render.dolp_bgr, lambda values: render.grey_bgr(values, 1)])
def test_only_one_plane_is_coloured(image, colour):
    with pytest.raises(TypeError, match=r"one plane .*image\.aop.* whole PolarFrame"):
        colour(image)
    with pytest.raises(ValueError, match=r"shape \(H, W\), got \(4, .*PolarFrame"):
        colour(image.quad)


@pytest.mark.parametrize(("call", "said"), [
    (lambda path: pdavis_cv.write_aedat4(path, "x.aedat4"), "recording must be .* str"),
    (lambda path: pdavis_cv.write_aedat2(path, None), "recording must be .* NoneType"),
    (lambda path: pdavis_cv.Aedat2Writer(path, sensor_size=None), "sensor_size must"),
    (lambda path: pdavis_cv.Analyser({}), "response must be .* got dict"),
    (lambda path: pdavis_cv.Calibration(sensor_size=None), "sensor_size must"),
    (lambda path: pdavis_cv.PolarFrame(None, t_us=0), "quad must be four planes")])
def test_an_error_names_the_argument_of_what_was_called(call, said, tmp_path):
    with pytest.raises((TypeError, ValueError), match=said):
        call(tmp_path / "x")


def test_degrees_are_not_taken_for_radians(image):
    with pytest.raises(ValueError, match=r"in radians, got 45; see np\.radians"):
        render.aop_bgr(np.full((2, 2), 45.0))
    render.aop_bgr(np.array([[-np.pi, 2 * np.pi, np.nan]]))


def test_a_summary_is_of_an_image(image):
    with pytest.raises(TypeError, match="image must be a PolarFrame, got ndarray"):
        render.summary(image.quad)


@pytest.mark.parametrize(("name", "meant"), [
    ("start", "start_us"), ("FPS", "fps"), ("framerate", "fps"),
    ("duration", "stop_us"), ("caussal", "causal"), ("lookahead", "lookahead_us")])
def test_an_unknown_option_names_the_one_that_is_meant(name, meant):
    with (pdavis_cv.open_recording(TENDON) as recording,
          pytest.raises(TypeError, match=f"did you mean {meant}[?]")):
        pdavis_cv.fuse(recording, **{name: 1})
    with pytest.raises(TypeError, match=f"did you mean {meant}[?]"):
        pdavis_cv.VideoCapture(TENDON, **{name: 1})


def test_an_option_of_opening_names_the_one_that_is_meant():
    with pytest.raises(TypeError, match=r"did you mean layout[?]"):
        pdavis_cv.open_recording(TENDON, layouts="pdavis")


def test_nothing_is_meant_by_what_is_like_no_name():
    assert instead("xyzzy", ["fps", "start_us"]) == ""
    assert instead(3, ["fps"]) == ""


@pytest.mark.parametrize("times", [
    {"times_us": [0, 1]}, {"start_us": 0}, {"stop_us": 5}, {"start_us": 10**17}])
def test_times_far_from_the_recordings_are_refused(times):
    unix = 1_600_000_000_000_000
    moved = pdavis_cv.recording_from_arrays(
        random_events(100, (8, 8), start_us=unix, stop_us=unix + 1_000_000),
        sensor_size=(8, 8), layout="pdavis")
    with pytest.raises(ValueError, match="recording's clock, which runs from 16000"):
        pdavis_cv.fuse(moved, **times)


def test_a_stop_after_the_end_takes_all_images():
    short = pdavis_cv.recording_from_arrays(
        random_events(100, (8, 8), stop_us=1000), sensor_size=(8, 8), layout="pdavis")
    images = [list(pdavis_cv.fuse(short, fps=4000, **stop))
              for stop in ({}, {"stop_us": 10**9})]
    assert [image.t_us for image in images[0]] == [image.t_us for image in images[1]]
    assert images[0]


def test_fuse_says_how_what_it_was_given_is_opened():
    for source in "simulate:fan", TENDON:
        with pytest.raises(TypeError, match=r"open_recording\(.*open_source\(address"):
            pdavis_cv.fuse(source)


def test_an_address_is_no_recording_and_says_where_it_belongs():
    with pytest.raises(OSError, match=r"simulate:fan.*pdavis_cv\.open_source"):
        pdavis_cv.open_recording("simulate:fan")


def test_one_output_is_chosen():
    with pytest.raises(TypeError, match=r"one name, got .*retrieve"):
        pdavis_cv.VideoCapture(TENDON, output=["aop", "dolp"])


def test_why_opening_failed_can_be_read_after_reading():
    capture = pdavis_cv.VideoCapture("no_such.aedat4")
    why = capture.last_error
    assert capture.read() == (False, None)
    assert capture.retrieve() == (False, None)
    assert not capture.set(0, 1)
    assert "no_such.aedat4: cannot be opened" in why
    assert capture.last_error == why
    assert capture.open(str(TENDON))
    capture.release()
    capture.read()
    assert capture.last_error == "the capture is not open"


def test_a_misspelt_public_name_says_the_nearest():
    with pytest.raises(AttributeError, match="did you mean VideoCapture"):
        _ = pdavis_cv.Videocapture


@pytest.fixture(scope="module")
def things():
    """A recording and what is read from it, by name."""
    with (pdavis_cv.open_recording(TENDON) as recording,
          pdavis_cv.VideoCapture(TENDON) as capture):
        packets = list(recording.packets())
        fusion = pdavis_cv.fuse(recording, fps=10)
        frame = next(packet.frames[0] for packet in packets if packet.frames)
        yield {"recording": recording, "info": recording.info, "packet": packets[0],
               "frame": frame, "fusion": fusion, "image": next(fusion),
               "ahead": ReadAhead(fusion), "capture": capture}


@pytest.mark.parametrize(("what", "said"), [
    ("recording.fps", "fps is an option of fuse"),
    ("recording.width", "info.sensor_size is"),
    ("recording.layout", "it is info.layout"),
    ("recording.sensor_size", "it is info.sensor_size"),
    ("recording.duration", "info.start_us and info.stop_us"),
    ("recording.frames", "for packet in recording.packets"),
    ("recording.scann", "did you mean scan"), ("recording.t", "recording.events()"),
    ("info.width", "sensor_size is"), ("info.duration", "stop_us - start_us"),
    ("packet.frame", "frames is a tuple"), ("packet.x", "events is an array"),
    ("frame.image", "it is dn"), ("frame.t_us", "mid_us"),
    ("fusion.frames", "a loop over it"), ("fusion.read", "call next"),
    ("ahead.images", "a loop over it"), ("image.width", "shape is"),
    ("image.timestamp", "it is t_us"), ("image.aop_deg", "numpy.degrees"),
    ("image.plot", "render.summary"), ("image.mask", "it is valid"),
    ("image.copy", "never changes"), ("image.to_numpy", "quad"),
    ("capture.fps", "CAP_PROP_FPS"), ("capture.width", "CAP_PROP_FRAME_WIDTH"),
    ("capture.close", "release")])
def test_a_name_of_other_libraries_is_answered_by_the_one_here(things, what, said):
    thing, name = what.split(".")
    with pytest.raises(AttributeError, match=rf"has no '{name}'; .*{re.escape(said)}"):
        getattr(things[thing], name)


@pytest.mark.parametrize("thing", [
    "recording", "frame", "image", "capture"])
def test_what_has_no_length_and_no_index_says_how_it_is_used(things, thing):
    for use in len, lambda it: it[0]:
        with pytest.raises(TypeError, match=r"(has no length|takes no index); .{10}"):
            use(things[thing])
    assert things[thing]    # true, whatever its length would be


def test_no_advice_is_about_a_name_that_there_is(things):
    kinds = {kind.__name__: kind for thing in things.values()
             for kind in type(thing).__mro__}
    assert [f"{kind}.{name}" for kind, advice in ADVICE.items() for names in advice
            for name in names.split() if hasattr(kinds[kind], name)] == []


@pytest.mark.parametrize("rows", [
    np.array([[1, 2, 3, 1]]), np.zeros((5, 4)), np.zeros((4, 0), np.uint16)])
def test_rows_of_numbers_are_no_events_and_columns_are(rows):
    for take in (lambda: pdavis_cv.accumulate(rows, (8, 8)),
                 lambda: pdavis_cv.recording_from_arrays(rows, sensor_size=(8, 8))):
        with pytest.raises(TypeError, match=r"mapping of columns, such as \{'t': a"):
            take()
    rows = np.array([[1, 2, 3, 1]])
    columns = dict(zip("txyp", rows.T, strict=True))
    assert pdavis_cv.accumulate(columns, (8, 8))[1, 3, 2] == 1


@pytest.mark.parametrize("source", [
    0, None, np.zeros((5, 4)), [], [0], {"path": "x"}])
def test_what_is_no_path_is_not_opened(source):
    with pytest.raises(TypeError, match=r"source must be a path.*from_arrays"):
        pdavis_cv.open_recording(source)
    with pytest.raises(TypeError, match="recording_from_arrays"):
        pdavis_cv.fuse(source)


def test_an_option_without_its_name_is_refused(things):
    with pytest.raises(TypeError, match=r"must be FusionOptions, got 100; .*by name"):
        pdavis_cv.fuse(things["recording"], 100)
    for opens in pdavis_cv.open_recording, pdavis_cv.open_source:
        with pytest.raises(TypeError, match="must be SourceOptions, got 'pdavis'; "):
            opens(TENDON, "pdavis")


def test_what_is_labelled_are_images(things):
    pytest.importorskip("xarray")
    for what in things["recording"], TENDON, [1]:
        with pytest.raises(TypeError, match=r"images must be PolarFrames, as fuse\("):
            pdavis_cv.export.to_xarray(what)


def test_a_calibration_is_loaded_first():
    with pytest.raises(TypeError, match=r"as Calibration\.load\(path\) gives"):
        pdavis_cv.FusionOptions(calibration="camera.npz")


def test_only_pictures_are_written_as_png(image, tmp_path):
    for what in image, image.dolp, [[1]]:
        with pytest.raises(TypeError, match=r"picture must be uint8 .*dolp_bgr"):
            pdavis_cv.export.write_png(tmp_path / "x.png", what)
    assert not list(tmp_path.iterdir())


def test_colours_need_what_they_say(image):
    with pytest.raises(ValueError, match="top must be positive, got 0"):
        render.dolp_bgr(image.dolp, top=0)
    with pytest.raises(TypeError, match="valid must be bool, got float32"):
        render.aop_bgr(image.aop, image.dolp)
    with pytest.raises(TypeError, match="picture must be uint8, got float32"):
        render.fade(image.aop, image.dolp)
    mask = np.where(image.valid, 255, 0).astype(np.uint8)      # as of cv2
    np.testing.assert_array_equal(
        render.aop_bgr(image.aop, mask), render.aop_bgr(image.aop, image.valid))


@pytest.mark.parametrize("name", ["to_xarray", "write_png"])
def test_a_name_of_a_module_below_is_found(name):
    with pytest.raises(AttributeError, match=rf"it is pdavis_cv\.export\.{name}$"):
        getattr(pdavis_cv, name)


@pytest.mark.parametrize("name", ["open", "read", "load", "imread"])
def test_what_opens_is_named(name):
    with pytest.raises(AttributeError, match="did you mean open_recording"):
        getattr(pdavis_cv, name)


@pytest.mark.parametrize(("line", "said"), [
    ("export R -o x.webm --framerate 30", "did you mean --fps?"),
    ("export R -o x.webm --frame-rate 30", "did you mean --fps?"),
    ("export R -o x.webm --duration 1", "did you mean --stop?"),
    ("export R -o x.webm --show dolp", "did you mean --quantities?"),
    ("export R -o x.webm --output y", "did you mean --out?"),
    ("export R -o x.webm --start 500ms", "a number without a unit, got '500ms'"),
    ("export R -o x.webm --fps 100Hz", "a number without a unit, got '100Hz'"),
    ("export R -o x.webm --stop -1", "--stop: must not be negative, got -1"),
    ("export R -o x.webm --roi 0,0,9", "4 numbers with commas between them, got"),
    ("export . -o x.webm", "a folder that is not a recording"),
    ("export R -o x.jpg", "must end in .webm"),
    ("convert R x.jpg", "must end in .aedat4"),
    ("view R --port 99999", "must lie in 0..65535"),
    ("view usb", "a camera has an address, such as usb:"),
    ("exprot R", "did you mean export?"), ("help", "see pdavis --help")])
def test_a_mistake_on_the_command_line_is_answered(line, said, tmp_path, monkeypatch,
                                                   capsys):
    monkeypatch.chdir(tmp_path)
    assert main([str(TENDON) if word == "R" else word for word in line.split()]) == 2
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1


def test_a_region_without_a_valid_pixel_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["tendon", str(example_recording("fan")), "-o", "t", "--region",
                 "hub=0,0,4,4", "--fps", "50", "--method", "cf"]) == 2
    assert "region hub: its DoLP is known in 0 images" in capsys.readouterr().err
