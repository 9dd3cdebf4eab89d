"""One blurred frame and its events say what the light was at any time near."""
import numpy as np
import pytest

from pdavis_cv import EVENT_DTYPE, ApsFrame, deblur
from pdavis_cv.simulation.ideal import rotating_polarizer

THETA = 0.15


def light_at(truth, layout, t, ratio=40.0):
    """Light behind the four polarizers, of extinction ratio `ratio`, up to a gain."""
    angle = np.deg2rad(layout.angles_deg)
    contrast = (ratio - 1) / (ratio + 1) * truth.dolp(t)
    return truth.s0(t) / 2 * (1 + contrast * np.cos(2 * (truth.aop(t) - angle)))


@pytest.mark.parametrize("shift_us", [-20_000, 0, 20_000])
def test_what_is_left_of_the_blur_is_a_quarter_of_a_threshold(shift_us):
    recording, truth = rotating_polarizer(200, 1.0, size=(2, 2), theta=(THETA, THETA))
    frames = [f for packet in recording.packets() for f in packet.frames][2:-2]
    blurred, left = [], []
    for frame in frames:
        t = frame.mid_us + shift_us
        want = np.log(light_at(truth, recording.info.layout, t))
        got = deblur(frame, recording.events(), theta_on=THETA, theta_off=THETA, t_us=t)
        assert got.valid.all()
        assert got.log_intensity.dtype == np.float32
        left.append(np.abs(got.log_intensity - want).max())
        blurred.append(np.abs(np.log(frame.dn / frame.exposure_ms) - want).max())
    assert max(left) < 0.26 * THETA
    assert max(blurred) > 0.4


def ramp(rate, exposure_us):
    """A pixel whose log intensity grows evenly: its mean over the exposure is known."""
    times = np.arange(1, 200) * round(1e6 * 0.2 / rate)
    events = np.zeros(len(times), EVENT_DTYPE)
    events["t"], events["p"] = times, 1
    start = 100_000
    whole = rate * exposure_us / 1e6
    # In DN per ms, intensity at the start of exposure is 10.
    dn = 10 * np.expm1(whole) / whole * exposure_us / 1000
    return ApsFrame(np.array([[dn]]), start, start + exposure_us), events, start


@pytest.mark.parametrize("exposure_us", [5_000, 30_000])
def test_a_ramp_is_followed_through_the_exposure(exposure_us):
    frame, events, start = ramp(10.0, exposure_us)
    for t in (start, start + exposure_us // 3, start + exposure_us):
        got = deblur(frame, events, theta_on=0.2, theta_off=0.2, t_us=t)
        want = np.log(10) + 10.0 * (t - start) / 1e6
        assert got.log_intensity[0, 0] == pytest.approx(want, abs=2e-3)
    middle = deblur(frame, events, theta_on=0.2, theta_off=0.2)
    assert middle.log_intensity[0, 0] == pytest.approx(
        np.log(10) + 10.0 * exposure_us / 2e6, abs=2e-3)


def test_without_events_the_frame_stays_and_bad_samples_are_not_valid():
    dn = np.array([[100.0, 0.0], [50.0, 200.0]], np.float32)
    valid = np.array([[True, True], [True, False]])
    frame = ApsFrame(dn, 0, 10_000, valid=valid)
    got = deblur(frame, np.zeros(0, EVENT_DTYPE), theta_on=0.2, theta_off=0.2)
    np.testing.assert_array_equal(got.valid, [[True, False], [True, False]])
    np.testing.assert_allclose(
        got.log_intensity[got.valid], np.log([10, 5]), atol=1e-6)


def test_events_out_of_order_or_place_are_refused():
    frame, events, _ = ramp(10.0, 5_000)
    with pytest.raises(ValueError, match=r"order|before"):
        deblur(frame, events[::-1].copy(), theta_on=0.2, theta_off=0.2)
    with pytest.raises(ValueError, match="theta_on"):
        deblur(frame, events, theta_on=0, theta_off=0.2)
    events["x"] = 3
    with pytest.raises(ValueError, match="outside"):
        deblur(frame, events, theta_on=0.2, theta_off=0.2)
