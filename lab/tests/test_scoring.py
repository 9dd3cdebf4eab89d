"""Errors relative to the truth are those that were put in."""
import numpy as np
import pytest

from lab.scoring import Scorer
from pdavis_cv.polarimetry import adopted
from pdavis_cv.simulation import Fan, RotatingPolarizer, Truth


def image(aop, dolp, *, t_us=0, shape=(3, 4), s0=10.0, variance=None, valid=None):
    """Light of known polarization, as an image says it; angles broadcast."""
    aop, dolp = np.broadcast_to(aop, shape), np.broadcast_to(dolp, shape)
    quad = np.array([s0 * (1 + dolp * np.cos(2 * (aop - a))) / 2
                     for a in np.deg2rad((0, 45, 90, 135))], np.float32)
    return adopted(
        quad, valid=np.ones(shape, np.bool_) if valid is None else valid, t_us=t_us,
        frame_us=None, extinction_ratio=None, analyser=None,
        variance=None if variance is None else np.full_like(quad, variance),
        provenance={})


def truth(size=(6, 8), dolp=1.0):
    return Truth(RotatingPolarizer(rpm=60, start_angle=3.1, dolp=dolp), size)


def test_errors_are_those_put_in():
    scorer = Scorer(truth(), (3, 4))
    for t in (0, 1000, 250_000):
        known = truth().aop(t)
        off = np.where(np.arange(4) % 2, 0.1, -0.1)  # cancels in the region's mean
        scorer.add(image(known + off, 0.9, t_us=t))
    score = scorer.score
    assert score.images == 3
    assert score.aop_error == pytest.approx(0.1, abs=1e-5)
    assert score.dolp_error == pytest.approx(0.1, abs=1e-5)
    assert score.roi_aop_error == pytest.approx(0, abs=1e-5)
    assert score.roi_dolp_error == pytest.approx(1 - 0.9 * np.cos(0.2), abs=1e-5)
    assert score.valid == 1
    assert np.isnan([score.aop_coverage, score.dolp_coverage]).all()


def test_the_range_of_a_full_turn_is_half_a_turn():
    scorer = Scorer(truth(), (3, 4))
    for t in range(0, 500_000, 1000):
        scorer.add(image(truth().aop(t), 1, t_us=t))
    assert scorer.score.roi_aop_range == pytest.approx(np.pi, abs=0.02)


def test_aop_counts_only_where_there_is_some():
    scorer = Scorer(truth(dolp=0.1), (3, 4))
    scorer.add(image(1.0, 0.1))
    assert np.isnan(scorer.score.aop_error)
    assert scorer.score.dolp_error == pytest.approx(0, abs=1e-5)


def test_honest_sigmas_cover_two_thirds():
    rng = np.random.default_rng(3)
    shape, sigma = (40, 50), 0.02
    known = Truth(RotatingPolarizer(rpm=60, dolp=0.6), (80, 100))
    scorer = Scorer(known, shape)
    for t in range(0, 100_000, 10_000):
        frame = image(known.aop(t), 0.6, t_us=t, shape=shape)
        noisy = frame.quad * np.exp(sigma * rng.standard_normal((4, *shape)))
        scorer.add(adopted(
            noisy.astype(np.float32), valid=np.ones(shape, np.bool_), t_us=t,
            frame_us=None, extinction_ratio=None, analyser=None,
            variance=np.full((4, *shape), sigma**2, np.float32), provenance={}))
    assert 0.66 < scorer.score.aop_coverage < 0.71
    assert 0.66 < scorer.score.dolp_coverage < 0.71


def test_a_value_that_is_not_finite_counts_as_a_guess():
    scorer = Scorer(truth(), (3, 4))
    frame = image(truth().aop(0), 1)
    quad = frame.quad.copy()
    quad[:, :, 0] = np.inf
    with np.errstate(invalid="ignore"):
        scorer.add(adopted(
            quad, valid=np.ones((3, 4), np.bool_), t_us=0, frame_us=None,
            extinction_ratio=None, analyser=None, variance=None, provenance={}))
    assert scorer.score.aop_error == pytest.approx(np.pi / 16, abs=1e-5)
    assert scorer.score.dolp_error == pytest.approx(0.25, abs=1e-5)
    assert scorer.score.roi_aop_error == pytest.approx(np.pi / 4)


def test_masked_pixels_and_edges_do_not_count():
    mask = np.zeros((3, 4), np.bool_)
    mask[1, 2] = True
    wrong = np.where(mask, truth().aop(0), 1.5)
    scorer = Scorer(truth(), (3, 4), mask=mask)
    scorer.add(image(wrong, np.where(mask, 1.0, 0.0)))
    assert scorer.score.aop_error == pytest.approx(0, abs=1e-5)

    fan = Truth(Fan(rpm=0.0), (260, 346))
    y, x = np.mgrid[:130, :173] * 2 + 0.5
    blurred = image(fan.aop(0, x, y), fan.dolp(0, x, y), shape=(130, 173))
    every, away = (Scorer(fan, (130, 173), margin=m) for m in (0.0, 1.5))
    for scorer in (every, away):
        scorer.add(blurred)
    assert np.isnan(every.score.roi_aop_error)
    assert 0 < away._seen < every._seen
