"""python -m lab.paper network: what is recorded, how it is scored, what is written."""
import csv
import math

import numpy as np
import pytest
import reference_network as reference

from lab.paper import command, network
from lab.paper.response import response_table
from lab.paper.run import Case, Settings
from pdavis_cv.reconstruct.weights import Weights
from pdavis_cv.simulation import RotatingPolarizer

PERIOD_US = 30e6 / 500


def polarizer(**more):
    return network.NetworkCase(
        case=Case(scene="polarizer", rpm=500, size=(12, 12), seconds=1.3,
                  light=lambda s0: RotatingPolarizer(rpm=500, s0=s0)),
        setting="500 RPM", period_us=PERIOD_US, **more)


@pytest.fixture(scope="module")
def rows():
    methods = ("joint", "firenet", "firenet, table", "events", "kalman")
    return {row.method: row for row in network.measure(
        polarizer(calibrated=True), Settings(methods=methods),
        network.all_weights(()))}


def test_windows_are_below_an_eighth_of_the_period():
    assert network.window_us(1e6) < 1e6 / 8
    assert network.window_us(100) == 1000
    for quick in (True, False):
        made = network.network_cases(Settings(quick=quick))
        assert len({(each.case.scene, each.setting) for each in made}) == len(made)
        for each in made:
            window = network.window_us(each.period_us)
            assert 1000 <= window <= each.period_us / 8
            # Longer memories than this are not settled when scoring begins.
            assert each.case.seconds * 1e6 > network.SETTLING * window + 1e5


def test_scenes_can_be_chosen():
    made = network.network_cases(Settings(scenes=("irradiance", "fan")))
    assert {each.case.scene for each in made} == {
        "fan", "irradiance, nominal", "irradiance, realistic"}
    made = network.network_cases(Settings())
    assert {each.case.scene.split(",")[0] for each in made} == set(network.SCENES)


def test_textures_cross_less_than_an_eighth_of_a_wave_per_window():
    textures = [each for each in network.network_cases(Settings())
                if each.case.scene == "texture"]
    assert len(textures) == len(network.TEXTURE_SEEDS)
    for each in textures:
        scene = each.case.light(30.0)
        moved = math.hypot(*scene.velocity) * network.window_us(each.period_us) / 1e6
        assert moved < scene.shortest / 8


@pytest.mark.gate
def test_methods_are_scored_at_ends_of_windows_after_they_settled(rows):
    window = network.window_us(PERIOD_US)
    assert {row.window_us for row in rows.values()} == {window}
    ends = np.arange(1, 1000) * window  # not the first second, nor the last 60 ms
    counted = int(((ends >= 1_000_000) & (ends < 1_240_000)).sum())
    assert {row.images for row in rows.values()} == {counted}
    assert rows["kalman"].dolp_error < 0.05
    assert rows["kalman"].aop_error_deg < 3
    assert np.isnan(rows["events"].dolp_error)
    for row in rows.values():
        assert row.aop_error_deg < 12


def test_the_papers_table_takes_the_networks_intensity_to_the_light(rows):
    own = Weights.shipped("firenet")
    pale = {**own.arrays, "pred.weight": own.arrays["pred.weight"] / 2,
            "pred.bias": own.arrays["pred.bias"] / 2 + np.float32(0.5)}
    got = {row.method: row for row in network.measure(
        polarizer(calibrated=True), Settings(methods=("firenet", "firenet, table")),
        {"firenet": Weights("firenet", pale)})}
    assert got["firenet"].dolp_error > 0.4
    assert got["firenet, table"].dolp_error == pytest.approx(
        rows["firenet, table"].dolp_error, abs=0.01)


def test_the_table_needs_a_cycle():
    assert [row.method for row in network.measure(
        polarizer(), Settings(methods=("firenet, table", "events")),
        network.all_weights(()))] == ["events"]


def test_error_of_s0_is_that_of_its_log_up_to_a_gain():
    recording, truth = polarizer().case.specimen(
        network.runs.METHODS["frames"]).record(RotatingPolarizer(rpm=500, s0=9), 0.1)
    light = network._Light(network.Take(recording, truth, 0, 100_000), (6, 6), None)

    class Image:
        t_us = 50_000
        s0 = np.full((6, 6), 4 * 9.0)

    light.add(Image)
    assert light.error == pytest.approx(0, abs=1e-12)
    Image.s0 = Image.s0 * np.where(np.arange(6) < 3, 1, math.exp(0.2))
    light.add(Image)
    assert light.error == pytest.approx(0.2 / 4)


def test_the_command_writes_a_table_a_page_and_the_cost(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(network, "network_cases", lambda settings: [polarizer()])
    monkeypatch.setattr(network.network_steps, "__defaults__", ((8, 8),))
    weights = reference.random_weights("joint")
    weights.save(tmp_path / "mine.npz")
    assert command.main([
        "network", "-o", str(tmp_path / "n"), "--quick", "--methods", "joint", "events",
        "--weights", str(tmp_path / "mine.npz")]) == 0
    page = (tmp_path / "n.md").read_text()
    assert f"joint: weights {weights.digest}, 41222 numbers" in page
    assert f"firenet: weights {Weights.shipped('firenet').digest}" in page
    assert "joint / firenet: " in page
    assert page in capsys.readouterr().out
    table = list(csv.DictReader((tmp_path / "n.csv").read_text().splitlines()))
    assert [line["method"] for line in table] == ["joint", "events"]
    assert 0 < float(table[1]["aop_error_deg"]) < 12
    assert weights.digest in (tmp_path / "n.csv.json").read_text()


def test_weights_that_are_none_are_one_line(tmp_path, capsys):
    (tmp_path / "w.pth.tar").write_text("not a checkpoint")
    assert command.main(["network", "-o", str(tmp_path / "n"), "--weights",
                           str(tmp_path / "w.pth.tar")]) != 0
    said = capsys.readouterr().err
    assert "w.pth.tar" in said
    assert said.count("\n") == 1


def test_a_table_takes_what_was_given_to_the_light():
    given = np.random.default_rng(0).uniform(0.1, 0.9, (4, 500))
    light = np.array([[1], [2], [3], [4]]) * given**2
    table = response_table(given, light)
    assert table.shape == (4, 2, 33)
    for one, true, (x, y) in zip(given, light, table, strict=True):
        assert (np.diff(x) > 0).all()
        assert (np.diff(y) >= 0).all()
        np.testing.assert_allclose(np.interp(one, x, y), true, atol=0.02)
    noisy = light + np.random.default_rng(1).normal(0, 0.2, light.shape)
    assert (np.diff(response_table(given, noisy)[:, 1]) >= 0).all()
    with pytest.raises(ValueError, match=r"given and light must be \(4, N\)"):
        response_table(given, light[:, :9])
    with pytest.raises(ValueError, match="given must vary"):
        response_table(np.ones((4, 9)), light[:, :9])
