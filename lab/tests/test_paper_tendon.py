"""Figure 4b: the tendon's traces and maps are what the light says."""
import dataclasses

import numpy as np
import pytest

from lab.paper import tendon_images
from lab.paper.run import OFF_LOCK, Settings
from lab.paper.tendon_images import Pull
from pdavis_cv.simulation import Tendon


def a_pull(method, t_us, dolp, hz=2.0):
    return Pull(hz, method, t_us, dolp, dolp, np.zeros((2, 2)))


def test_an_amplitude_is_that_of_the_cosine_at_a_frequency():
    t = np.arange(0, 2_000_000, 7000)
    wave = 0.4 + 0.13 * np.cos(2e-6 * np.pi * 2.0 * t + 1.0) + 0.05 * np.cos(
        2e-6 * np.pi * 5.0 * t)
    assert tendon_images.amplitude_at(a_pull("m", t, wave), wave, 2.0) == (
        pytest.approx(0.13, rel=0.02))


def test_the_error_of_few_images_is_that_of_straight_lines_between_them():
    dense, few = np.arange(0, 1_000_000, 1000), np.arange(0, 1_000_001, 250_000)
    wave = np.cos(2e-6 * np.pi * 2.0 * dense)
    truth = a_pull("truth", dense, wave)
    seen = a_pull("frames", few, np.cos(2e-6 * np.pi * 2.0 * few))   # 1, -1, 1 ...
    line = 1 - 4 * np.abs(dense / 5e5 % 1 - np.rint(dense / 5e5 % 1)) % 4
    assert tendon_images.error(seen, [truth, seen]) == pytest.approx(
        np.abs(np.interp(dense, few, seen.dolp) - wave).mean())
    assert np.abs(np.interp(dense, few, seen.dolp) - line).max() < 1e-9


@pytest.mark.gate
def test_truth_and_frames_have_the_amplitude_of_the_retardance():
    settings = dataclasses.replace(
        Settings(quick=True), methods=("frames, own times",))
    made = [pull for pull in tendon_images.pulls(settings) if pull.hz < 2]
    truth, frames = made
    # DoLP is sin of the retardance, which swings by `gain` about its mean.
    scene = Tendon(hz=OFF_LOCK)
    swing = np.sin(scene.retardance * (1 + scene.gain * np.array([-1, 1])))
    assert truth.dolp.min() == pytest.approx(swing[0], abs=0.03)
    assert truth.dolp.max() == pytest.approx(swing[1], abs=0.03)
    # 20 ms of a second blur nothing: sinc(.02) = .9993.
    assert tendon_images.error(frames, made) < 0.01
    np.testing.assert_allclose(frames.amplitude.mean(), truth.amplitude.mean(),
                               rtol=0.05)


def test_a_trace_follows_if_it_has_most_of_the_swing():
    t = np.arange(0, 1_000_000, 1000)
    wave = 0.4 + 0.2 * np.cos(2e-6 * np.pi * 2.0 * t)
    made = [a_pull("truth", t, wave), a_pull("kalman", t, wave * 0.9 + 0.1),
            a_pull("cf", t, 0.4 + (wave - 0.4) / 2)]
    assert tendon_images._follows(made, 2.0) == (
        "-; follow: kalman; do not: cf (0.50 of the swing)")
    frames = a_pull("frames, own times", t, np.full(len(t), 0.4))
    said = tendon_images._follows([*made, frames, a_pull("joint", t, wave)], 2.0)
    assert said.startswith("differs; follow: kalman, joint; do not")   # slow: frames do
    fast = [dataclasses.replace(pull, hz=10.0) for pull in (made[0], frames)]
    assert tendon_images._follows(fast, 10.0).startswith("agrees; follow: none")
