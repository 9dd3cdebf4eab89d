"""Train networks: chunks of clips, truncated back-propagation, checkpoints."""
from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from pdavis_cv._beside import write_beside
from pdavis_cv.reconstruct.weights import Weights

from .clips import UNIT, Chunk, Clips
from .networks import WIDTH
from .tasks import Task, task_of


@dataclass(frozen=True)
class Recipe:
    """Parameters of the training of a network.

    Parameters
    ----------
    network : {"joint", "firenet"}
    seed : int
        Seed of the initial weights and of the clips.
    steps : int
        Number of updates, over which the rate decreases as a cosine.
    rate : float
        Largest learning rate of Adam.
    batch, side, windows : int
        Number of clips, their height and width in macropixels, and number of windows
        through which errors are propagated back.
    half : bool
        Convolve in bfloat16; states and losses stay float32.
    """

    network: str = "joint"
    seed: int = 0
    steps: int = 20_000
    rate: float = 2e-3
    batch: int = 6
    side: int = 32
    windows: int = 8
    half: bool = False


class Trainer:
    """Train a network step by step; the state can be saved and loaded.

    Parameters
    ----------
    recipe : Recipe
    """

    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe
        torch.manual_seed(recipe.seed)
        self._task = task_of(recipe.network)
        self.net = self._task.network()
        self.optimizer = torch.optim.Adam(self.net.parameters(), lr=recipe.rate)
        self.clips = Clips(recipe.batch, recipe.side, recipe.seed)
        shape = (recipe.batch * self._task.runs, WIDTH, recipe.side, recipe.side)
        self.states = [torch.zeros(shape), torch.zeros(shape)]
        self.step = 0
        self.pixel_steps = 0  # number of cells times windows so far

    def advance(self) -> dict[str, float]:
        """Do one update; return its loss and errors."""
        recipe, net = self.recipe, self.net
        done = min(self.step / recipe.steps, 1)
        rate = recipe.rate * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * done)))
        for group in self.optimizer.param_groups:
            group["lr"] = rate * min(1, (self.step + 1) / 100)
        chunk = self.clips.chunk(recipe.windows)
        outputs = self._forward(chunk)
        loss, scores = score(outputs, chunk, self._task)
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        self.optimizer.step()
        self.step += 1
        self.pixel_steps += recipe.batch * recipe.side**2 * recipe.windows
        return scores

    def _forward(self, chunk: Chunk) -> torch.Tensor:
        keep = (~chunk.fresh).float().repeat_interleave(self._task.runs)
        h1, h2 = (h.detach() * keep.view(-1, 1, 1, 1) for h in self.states)
        inputs = self._task.inputs(chunk)
        outputs = []
        with torch.autocast("cpu", torch.bfloat16, enabled=self.recipe.half):
            for x in inputs:
                y, h1, h2 = self.net(x, h1, h2)
                outputs.append(y)
        self.states = [h1.detach(), h2.detach()]
        k, n, _, _, h, w = chunk.voxels.shape
        return torch.stack(outputs).view(k, n, -1, h, w)

    # ---- checkpoints ---------------------------------------------------------

    def save(self, path: Path) -> None:
        """Write a checkpoint from which training can continue."""
        state = {"recipe": asdict(self.recipe), "step": self.step,
                 "pixel_steps": self.pixel_steps,
                 "net": self.net.state_dict(),
                 "optimizer": self.optimizer.state_dict(), "states": self.states,
                 "clips": self.clips.state()}
        with write_beside(path) as part:
            torch.save(state, part)

    @classmethod
    def load(cls, path: Path, recipe: Recipe | None = None) -> Trainer:
        """Continue from a trusted checkpoint (it is a pickle).

        Parameters
        ----------
        path : Path
        recipe : Recipe, optional
            New parameters; clips continue only if seed and sizes are equal.

        Raises
        ------
        ValueError
            If the recipe is for the other network.
        """
        state = torch.load(path, weights_only=False)
        trainer = cls(recipe or Recipe(**state["recipe"]))
        if state["recipe"]["network"] != trainer.recipe.network:
            raise ValueError(
                f"{path} is of network {state['recipe']['network']!r}, not "
                f"{trainer.recipe.network!r}")
        trainer.net.load_state_dict(state["net"])
        trainer.optimizer.load_state_dict(state["optimizer"])
        trainer.step, trainer.pixel_steps = state["step"], state["pixel_steps"]
        same = ("batch", "side", "seed")
        if all(state["recipe"][name] == getattr(trainer.recipe, name)
               for name in same):
            trainer.states = state["states"]
            trainer.clips.restore(state["clips"])
        return trainer

    def weights(self, **about: Any) -> Weights:
        """Return the current weights, for `Weights.save`."""
        arrays = {name: value.detach().numpy().copy()
                  for name, value in self.net.state_dict().items()}
        return Weights(self.recipe.network, arrays, UNIT, {
            "recipe": asdict(self.recipe), "step": self.step,
            "pixel_steps": self.pixel_steps, **about})


def score(
    outputs: torch.Tensor, chunk: Chunk, task: Task
) -> tuple[torch.Tensor, dict[str, float]]:
    """Return the loss, and errors by kind of scene.

    The loss is the sum of the mean absolute errors of S1/S0, S2/S0 and DoLP (with the
    first two alone, DoLP would become too small where the angle is uncertain), and a
    third of that of ln S0 up to one gain per clip and chunk, and the task's own part.
    """
    log_s0, polar = task.measured(outputs)
    true_s0, true = task.true_s0(chunk.log_s0), chunk.polar
    weight = chunk.age / (chunk.age + 4)
    weight = (weight / weight.mean())[..., None, None, None]
    off = log_s0 - true_s0
    gain = off.mean((0, 2, 3, 4), keepdim=True)
    light = (off - gain).abs() * weight
    # Unlike hypot, norm has a gradient at 0.
    degree, true_degree = (
        torch.linalg.vector_norm(p, dim=2, keepdim=True) for p in (polar, true))
    loss = (2 * ((polar - true).abs() * weight).mean() + light.mean() / 3
            + ((degree - true_degree).abs() * weight).mean())
    loss = loss + task.own_loss(outputs, chunk, true_s0, gain, weight)
    with torch.no_grad():
        scores = {"loss": float(loss.detach()), "light": float(light.mean())}
        (s1, s2), (t1, t2) = polar.unbind(2), true.unbind(2)
        dolp = (degree - true_degree).abs()[:, :, 0]
        turned = torch.atan2(s2 * t1 - s1 * t2, s1 * t1 + s2 * t2).abs()
        sure = true_degree[:, :, 0] > 0.3
        old = chunk.age[-1] > 16
        for i, kind in enumerate(chunk.kinds):
            if old[i]:
                scores[f"{kind} dolp"] = float(dolp[:, i].mean())
                if sure[:, i].any():
                    scores[f"{kind} aop"] = math.degrees(
                        float(turned[:, i][sure[:, i]].mean()) / 2)
    return loss, scores


class Averages:
    """Means of scores since the last `take`."""

    def __init__(self) -> None:
        self._sums: dict[str, tuple[float, int]] = {}

    def add(self, scores: dict[str, float]) -> None:
        """Add scores."""
        for name, value in scores.items():
            total, n = self._sums.get(name, (0.0, 0))
            self._sums[name] = total + value, n + 1

    def take(self) -> dict[str, float]:
        """Return the means and reset them."""
        means = {name: total / n for name, (total, n) in sorted(self._sums.items())}
        self._sums = {}
        return means


def train(
    trainer: Trainer, path: Path, *, every: int = 200,
    told: Callable[[dict[str, float]], None] = lambda scores: None,
    shown: Callable[[range], Iterable[int]] = iter,
) -> None:
    """Train to the end of the recipe, and save to path every `every` steps.

    ``told`` receives the scores, and ``shown`` iterates over steps to show progress.
    """
    averages = Averages()
    for _ in shown(range(trainer.step, trainer.recipe.steps)):
        averages.add(trainer.advance())
        if trainer.step % every == 0 or trainer.step == trainer.recipe.steps:
            trainer.save(path)
            told(averages.take())
