"""Specimens and start angles that figures take if none are asked for."""
import numpy as np
import pytest

from lab.paper import network, rotation, rotation_networks
from lab.paper.command import settings_of
from lab.paper.run import SETTLE_US, Settings


@pytest.mark.parametrize("figure", ["fig2", "fig3"])
def test_errors_against_speed_are_of_ten_specimens_at_ten_start_angles(figure):
    found = settings_of([figure, "-o", "x"]).specimens
    assert len({seed for seed, _ in found}) == len({start for _, start in found}) == 10
    assert settings_of([figure, "-o", "x", "--quick"]).specimens == [(1, 17.0)]
    asked = settings_of([figure, "-o", "x", "--seeds", "2", "3", "--starts-deg", "0"])
    assert asked.specimens == [(2, 0.0), (3, 0.0)]


@pytest.mark.parametrize("figure", ["fig4a", "dr"])
def test_others_are_of_one(figure):
    assert settings_of([figure, "-o", "x"]).specimens == [(1, 17.0)]


def test_pages_say_which():
    settings = Settings(seeds=(1, 2), starts_deg=())
    assert settings.told_specimens == (
        "specimens 1, 2, start angles 17, 35 degrees, one each: lines are medians, "
        "bands 5 to 95 %")


@pytest.mark.parametrize("figure", ["fig2", "fig3"])
def test_a_network_is_given_time_to_settle_and_the_light_repeats(figure):
    for scene in rotation.SCENES[figure]:
        for case in rotation.cases(scene, Settings()):
            made = rotation_networks.network_case(case, scene)
            window = network.window_us(made.period_us)
            settled = max(SETTLE_US, network.SETTLING * window)
            assert made.case.seconds * 1e6 > settled + 400_000
            assert 1000 <= window <= made.period_us / 8
            light = case.light(30.0)
            half = case.turn_us / 2
            np.testing.assert_allclose(
                light.stokes(12_345.0 + half, 0, 0), light.stokes(12_345.0, 0, 0),
                atol=1e-6)
