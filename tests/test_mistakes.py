"""Mistakes of new users are answered by what to do instead."""
import numpy as np
import pytest
from streams import random_events

import pdavis_cv
from pdavis_cv import render
from pdavis_cv.data import example_recording
from pdavis_cv.registry import instead

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


def test_degrees_are_not_taken_for_radians(image):
    with pytest.raises(ValueError, match=r"in radians, got 45; see np\.radians"):
        render.aop_bgr(np.full((2, 2), 45.0))
    render.aop_bgr(np.array([[-np.pi, 2 * np.pi, np.nan]]))


def test_a_summary_is_of_an_image(image):
    with pytest.raises(TypeError, match="image must be a PolarFrame, got ndarray"):
        render.summary(image.quad)


@pytest.mark.parametrize(("name", "meant"), [
    ("start", "start_us"), ("FPS", "fps"), ("framerate", "fps"),
    ("duration", "stop_us"), ("caussal", "causal"), ("bandwith", "bandwidth")])
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
