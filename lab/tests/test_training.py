"""Training: what is simulated is what a camera gives, and it learns."""
import json

import numpy as np
import pytest

pytest.importorskip("torch")

import torch
from ideal import pixel_events

from lab.training.__main__ import main
from lab.training.clips import UNIT, Clips
from lab.training.scenery import KINDS, Motion
from lab.training.trainer import Recipe, Trainer
from pdavis_cv import EVENT_DTYPE
from pdavis_cv.reconstruct.firenet import Joint
from pdavis_cv.reconstruct.weights import Weights

TINY = {"batch": 2, "side": 8, "windows": 4}


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("network", ["joint", "firenet"])
def test_a_tiny_run_lowers_its_loss(network):
    trainer = Trainer(Recipe(network, steps=30, rate=5e-3, **TINY))
    chunk = trainer.clips.chunk(4)
    trainer.clips.chunk = lambda windows: chunk
    losses = [trainer.advance()["loss"] for _ in range(30)]
    assert losses[-1] < 0.7 * losses[0]


@pytest.mark.parametrize("network", ["joint", "firenet"])
def test_training_resumes_bit_equal(network, tmp_path):
    recipe = Recipe(network, steps=6, **TINY)
    whole = Trainer(recipe)
    for _ in range(3):
        whole.advance()
    whole.save(tmp_path / "c.pt")
    again = Trainer.load(tmp_path / "c.pt")
    for _ in range(3):
        assert whole.advance() == again.advance()
    assert (whole.step, whole.pixel_steps) == (again.step, again.pixel_steps) == (
        6, 6 * 2 * 64 * 4)
    for name, value in whole.weights().arrays.items():
        np.testing.assert_array_equal(again.weights().arrays[name], value)
    with pytest.raises(ValueError, match="is of network"):
        Trainer.load(tmp_path / "c.pt", Recipe(
            {"joint": "firenet", "firenet": "joint"}[network], **TINY))


def test_the_command_trains_and_goes_on(tmp_path, capsys):
    out = tmp_path / "w.npz"
    args = ["joint", "-o", str(out), "--batch", "1", "--side", "6",
            "--every", "1"]
    assert main([*args, "--steps", "1"]) == 0
    capsys.readouterr()
    assert main([*args, "--steps", "2", "--json", "--progress"]) == 0
    printed = capsys.readouterr()
    assert "going on from step 1" in printed.err
    assert "steps/s" in printed.err
    assert json.loads(printed.out)["step"] == 2
    weights = Weights.load(out)
    assert weights.about["step"] == 2
    assert weights.about["recipe"]["steps"] == 2
    rows = (tmp_path / "w.csv").read_text().splitlines()
    assert rows[0] == "step,pixel_steps,score,mean"
    assert any(row.startswith("2,576,loss,") for row in rows)
    method = Joint((8, 8), theta_on=0.2, theta_off=0.2, weights=out)
    method.add_events(np.array([(5, 1, 1, 1)], EVENT_DTYPE))
    assert np.isfinite(method.read(20_000).log_intensity).all()
    for bad in (["--steps", "0"], ["--side", "3"], ["-o", "w.pt"]):
        assert main([*args, *bad]) == 2


@pytest.mark.parametrize("kind", KINDS)
def test_clips_hold_what_they_say(kind):
    clips = Clips(3, 6, 5, kind=kind)
    parts = [clips.chunk(4) for _ in range(6)]
    assert parts[0].fresh.all()
    for part in parts:
        assert part.kinds == [kind] * 3
        assert part.voxels.shape == (4, 3, 4, 5, 6, 6)
        for tensor in part[:6]:
            assert torch.isfinite(tensor).all()
        assert (torch.hypot(*part.polar.unbind(2)) <= 1).all()
        assert (part.light > 0).all()
    # The four channels see S0 / 2 on average: exactly, where S0 and S are even.
    if kind in ("polarizer", "plate"):
        light = parts[-1].light
        both = light[:, :, 0] + light[:, :, 2] - light[:, :, 1] - light[:, :, 3]
        assert both.abs().median() < 0.05 * light.mean()


def test_clips_go_on_bit_equal_from_their_state():
    clips = Clips(2, 6, 1, renew=0.5)
    clips.chunk(4)
    kept = clips.state()
    want = clips.chunk(4)
    again = Clips(2, 6, 9, renew=0.5)
    again.restore(kept)
    got = again.chunk(4)
    for one, other in zip(want[:6], got[:6], strict=True):
        assert torch.equal(one, other)
    assert got.kinds == want.kinds


def test_events_of_a_turning_polarizer_are_those_of_the_closed_form(monkeypatch):
    """Voxel grids of a clip against exact threshold crossings."""
    clips = Clips(1, 4, 3, renew=0, kind="polarizer")
    clips._begin(0)
    spin, k, theta = 0.3, 0.9, 0.2
    clips._motion[0] = Motion("polarizer", np.zeros(2), spin=spin)
    phase = clips._path[0].phase
    clips._maps[0] = torch.tensor([0.0, 1.0, 0.0]).view(3, 1, 1)
    clips._theta[:, 0] = clips._nominal[:, 0] = theta
    clips._pixel[:, 0] = torch.tensor([k, 1e-9, 1e6, 0.0]).view(4, 1, 1, 1)
    clips._noise[0] = 0
    seen = 0.5 * (1 + k * np.cos(phase - np.arange(4) * np.pi / 2))
    clips._seen[0] = torch.from_numpy(np.log(seen)).view(4, 1, 1)
    clips._reference[0] = clips._seen[0]
    clips._last[0, 4:] = np.array(
        [[np.cos(phase), -np.sin(phase)], [np.sin(phase), np.cos(phase)]]).ravel()
    monkeypatch.setattr(clips, "_begin", lambda i: None)
    windows, window_us = 40, 10_000
    got = torch.cat([clips.chunk(8).voxels for _ in range(5)])[:, 0, :, :, 1, 1]
    for c in range(4):
        t, p = pixel_events(phase - c * np.pi / 2, spin / window_us, k, theta, theta,
                            windows * window_us)
        want = np.zeros((windows, 5))
        for at, up in zip(t / window_us, p, strict=True):
            place = 4 * (at % 1)
            b = int(place)
            step = (1 if up else -1) * theta / UNIT
            want[int(at), b] += step * (1 - place + b)
            want[int(at), b + 1] += step * (place - b)
        # Log light is taken as linear between nodes 0.04 radians apart.
        np.testing.assert_allclose(got[:, c].numpy(), want, atol=0.12)
        assert np.abs(want).sum() > 20
