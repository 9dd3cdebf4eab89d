"""Dark frames, flat frames and polarizer sweeps of a sensor with known maps."""
import numpy as np
import pytest

from pdavis_cv import (
    ApsFrame,
    PolarFrame,
    open_recording,
    recording_from_arrays,
    write_aedat4,
)
from pdavis_cv.calibration.frames import dark_frame, flat_frame, mean_frame
from pdavis_cv.calibration.sweep import fit_sweep, read_sweep

SIZE = (24, 24)
LAYOUT_DEG = np.tile([[135, 90], [0, 45]], (12, 12))


def frames(dn, n, rng, noise=2.0, **kwargs):
    return [ApsFrame(np.round(dn + noise * rng.normal(size=SIZE)), k * 50_000,
                     k * 50_000 + 20_000, **kwargs) for k in range(n)]


def test_a_dark_frame_finds_offset_noise_hot_and_noisy_pixels():
    rng = np.random.default_rng(0)
    offset = 3 + 1.5 * rng.normal(size=SIZE)
    offset[5, 6] = 90
    noise = np.full(SIZE, 2.0)
    noise[7, 8] = 30
    dark = dark_frame(frames(offset, 100, rng, noise))
    error = dark.dark - offset
    error[7, 8] = 0
    assert np.std(error) == pytest.approx(2 / 10, rel=0.15)
    assert np.median(dark.noise) == pytest.approx(np.hypot(2, 12**-.5), rel=0.03)
    assert np.argwhere(~dark.usable).tolist() == [[5, 6], [7, 8]]
    assert dark.frames == 100


def test_the_mean_leaves_out_what_is_not_valid():
    rng = np.random.default_rng(0)
    valid = np.ones(SIZE, bool)
    valid[0, 0] = False
    bright = ApsFrame(np.full(SIZE, 500.0), 0, 1, valid=valid)
    mean, n = mean_frame([*frames(np.zeros(SIZE), 10, rng, 0.0), bright])
    assert n == 11
    assert mean.mean[0, 0] == 0
    assert mean.mean[1, 1] == pytest.approx(500 / 11)


def test_a_flat_frame_gives_the_gain_and_finds_dead_pixels():
    rng = np.random.default_rng(0)
    gain = 1 + 0.02 * rng.normal(size=SIZE)
    response = 400 / gain
    response[3, 3] = 5
    flat = flat_frame(frames(response + 10, 50, rng), np.full(SIZE, 10, np.float32))
    ratio = np.delete((flat.gain / gain).ravel(), 3 * 24 + 3)
    assert np.std(ratio) < 0.001
    assert np.argwhere(~flat.usable).tolist() == [[3, 3]]


def test_frames_that_cannot_do_are_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="at least one frame, got none"):
        dark_frame([])
    with pytest.raises(ValueError, match="at least two frames, got 1"):
        dark_frame(frames(np.zeros(SIZE), 1, rng))
    with pytest.raises(ValueError, match="needs light"):
        flat_frame(frames(np.zeros(SIZE), 3, rng))
    with pytest.raises(ValueError, match="five different angles, got 2"):
        read_sweep([(0.0, frames(np.ones(SIZE), 2, rng)),
                    (1.0, frames(np.ones(SIZE), 2, rng)),
                    (1.0 + np.pi, frames(np.ones(SIZE), 2, rng))])


@pytest.fixture(scope="module", params=[180, 355])
def swept(request):
    """A sweep of a chip with known maps, a polarized lamp and a wandering beam."""
    rng = np.random.default_rng(request.param)
    angle = np.deg2rad(LAYOUT_DEG + 0.7 * rng.normal(size=SIZE))
    ratio = 40 + 3 * rng.normal(size=SIZE)
    gain = 1 + 0.02 * rng.normal(size=SIZE)
    dark = 5 + 2 * rng.normal(size=SIZE)
    wander = 0.01 if request.param > 180 else 0.0

    def expose(a, n):
        light = 1 + .03 * np.cos(2 * a) - .02 * np.sin(2 * a) + wander * np.sin(a)
        dn = 600 * light * gain * (
            (1 + 1 / ratio) + (1 - 1 / ratio) * np.cos(2 * (a - angle))) / 2
        return frames(dn + dark, n, rng, np.sqrt(dn / 20 + 1.5**2))

    steps = [(np.deg2rad(d), expose(np.deg2rad(d), 30))
             for d in range(0, request.param + 1, 5)]
    sweep = read_sweep(steps, dark=dark.astype(np.float32))
    return fit_sweep(sweep), angle, ratio, gain, wander, expose, dark


def test_a_sweep_gives_extinction_ratio_angle_and_gain_of_every_pixel(swept):
    fit, angle, ratio, gain, *_ = swept
    for place in range(4):
        part = np.s_[place // 2::2, place % 2::2]
        assert np.median(fit.extinction_ratio[part]) == pytest.approx(
            np.median(ratio[part]), rel=0.02)
    error = (fit.angle - angle + np.pi / 2) % np.pi - np.pi / 2
    assert np.rad2deg(np.abs(error).max()) < 0.1
    relative = fit.analyser[..., 0] / (gain * (1 + 1 / ratio))
    assert np.std(relative) / np.mean(relative) < 0.002
    assert fit.usable.all()


def test_standard_errors_of_a_sweep_cover_the_truth(swept):
    fit, angle, ratio, gain, *_ = swept
    response = fit.analyser[..., 0] / (gain * (1 + 1 / ratio))
    errors = {
        "angle": (((fit.angle - angle + np.pi / 2) % np.pi - np.pi / 2),
                  fit.angle_sigma),
        "extinction ratio": (fit.extinction_ratio - ratio, fit.extinction_ratio_sigma),
        "gain": (response / np.mean(response) - 1,
                 fit.sigma[..., 0] / fit.analyser[..., 0])}
    for name, (error, sigma) in errors.items():
        covered = np.mean(np.abs(error) < sigma)
        assert 0.60 < covered < 0.76, name


def test_an_error_of_the_dark_frame_counts_in_extinction_ratios():
    rng = np.random.default_rng(3)
    ratio = 40 + 3 * rng.normal(size=SIZE)
    angles = np.deg2rad(np.arange(0, 180, 10))

    def expose(a):
        dn = 300 * (1 + 1 / ratio + (1 - 1 / ratio) * np.cos(
            2 * (a - np.deg2rad(LAYOUT_DEG))))
        return frames(dn, 10, rng, np.sqrt(dn / 20 + 1.5**2))

    steps = [(a, list(expose(a))) for a in angles]
    dark = np.float32(0.5) * rng.normal(size=SIZE).astype(np.float32)
    covered = []
    for sigma in (0.0, 0.5):
        fit = fit_sweep(read_sweep(steps, dark=dark, dark_sigma=sigma))
        covered.append(np.mean(
            np.abs(fit.extinction_ratio - ratio) < fit.extinction_ratio_sigma))
    assert covered[0] < 0.55
    assert 0.60 < covered[1] < 0.76


def test_a_sweep_tells_the_lamp_s_polarization_from_the_pixels(swept):
    fit, *_, wander, _, _ = swept
    assert fit.source == pytest.approx((0.03, -0.02), abs=3e-4)
    assert fit.wander == pytest.approx((0, wander), abs=3e-4)


def test_the_analyser_matrix_takes_the_static_error_away(swept):
    """Mean of 20 frames: below .08 deg and .002; without it about .5 deg and .05."""
    fit, _, _, _, _, expose, dark = swept
    a = np.deg2rad(73.0)
    mean, _ = mean_frame(expose(a, 20))
    dn = (mean.mean - dark).astype(np.float32)

    def errors(quads, analyser):
        image = PolarFrame(quads, analyser=analyser)
        off = (image.aop.astype(float) - a + np.pi / 2) % np.pi - np.pi / 2
        return np.rad2deg(np.abs(off).mean()), np.abs(image.dolp - 1).mean()

    order = [2, 3, 1, 0]          # places of 0, 45, 90, 135 in the cell
    cells = np.stack([dn[i // 2::2, i % 2::2] for i in order])
    response = np.stack([fit.analyser[i // 2::2, i % 2::2] for i in order])
    calibrated = errors(cells, np.moveaxis(response, 3, 1))
    plain = errors(cells, None)
    assert calibrated[0] <= 0.08
    assert calibrated[1] <= 0.002
    assert plain[0] > 0.3
    assert plain[1] > 0.03


@pytest.mark.parametrize(("offset", "spread", "noise"), [
    (0.0, 0.5, 2.0), (1.0, 0.5, 2.0), (-1.0, 0.3, 1.5), (6.0, 1.0, 2.0)])
def test_a_dark_frame_is_unbiased_where_the_format_lost_the_sign(
        tmp_path, offset, spread, noise):
    rng = np.random.default_rng(3)
    truth = offset + spread * rng.normal(size=SIZE)
    images = [ApsFrame(np.rint(truth + noise * rng.normal(size=SIZE)), t, t + 5_000)
              for t in range(0, 2_000_000, 20_000)]
    recording = recording_from_arrays(None, images, sensor_size=SIZE)
    lost = write_aedat4(tmp_path / "dark.aedat4", recording)
    assert lost["pixels with negative DN were stored as 0"] > 0 or offset > 5
    with open_recording(tmp_path / "dark.aedat4") as stored:
        dark = dark_frame(stored)
    exact = dark_frame(recording)
    assert exact.clamped == 0
    assert abs(np.mean(exact.dark - truth)) < 0.05
    # Clamping lifts the mean of N(0, 2) by 0.8 DN.
    assert abs(np.mean(dark.dark - truth)) < 0.06
    assert np.std(dark.dark - truth) < 2.5 * np.std(exact.dark - truth)
    assert np.median(dark.noise) == pytest.approx(noise, rel=0.06)
    assert dark.clamped == pytest.approx(np.mean(
        [np.mean(image.dn <= 0) for image in images]), abs=0.01) or offset > 5


def test_a_sensor_that_reads_zero_everywhere_is_left_alone():
    zeros = [ApsFrame(np.zeros(SIZE), t, t + 5) for t in range(0, 100, 10)]
    dark = dark_frame(zeros)
    assert not dark.dark.any()
    assert dark.clamped == 1
