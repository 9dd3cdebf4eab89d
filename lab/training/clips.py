"""Simulate an endless stream of clips: events of four channels, and the truth."""
from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from pdavis_cv.reconstruct.firenet import PLACES
from pdavis_cv.reconstruct.weights import BINS, MEMORY

from .scenery import MAP_SIDE, Motion, Path, draw_map, draw_motion, walk

STEPS = 8
"""Times per window at which light is computed; two per interval between bins."""

UNIT = 0.2
"""Change of log intensity that is 1 in the voxel grid."""

Truth = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


class Chunk(NamedTuple):
    """Some consecutive windows of a batch of clips.

    Parameters
    ----------
    voxels : tensor of float32, shape (K, N, 4, BINS, H, W)
        Events of each channel in units of ``UNIT``.
    integrals : tensor of float32, shape (K, N, 4, 2, H, W)
        Leaky integrals of each channel's events, natural-log units.
    light : tensor of float32, shape (K, N, 4, H, W)
        Light on each pixel behind its polarizer at the window's end.
    log_s0 : tensor of float32, shape (K, N, 4, H, W)
        Natural log of S0 before each pixel.
    polar : tensor of float32, shape (K, N, 2, H, W)
        S1/S0 and S2/S0 in the middle of each cell, in front of the polarizers.
    age : tensor of float32, shape (K, N)
        Number of windows since the clip began.
    fresh : tensor of bool, shape (N,)
        Clips that begin with this chunk.
    kinds : list of str
    """

    voxels: torch.Tensor
    integrals: torch.Tensor
    light: torch.Tensor
    log_s0: torch.Tensor
    polar: torch.Tensor
    age: torch.Tensor
    fresh: torch.Tensor
    kinds: list[str]


class Clips:
    """Simulate clips chunk by chunk.

    Parameters
    ----------
    n : int
        Number of clips in parallel.
    side : int
        Height and width of a clip in macropixels.
    seed : int
    renew : float
        Probability that a clip is replaced by a new one at the beginning of a chunk.
    kind : str, optional
        Simulate only scenes of this kind.
    """

    def __init__(
        self, n: int, side: int, seed: int, *, renew: float = 0.12,
        kind: str | None = None,
    ) -> None:
        self.n, self.side, self.renew, self.kind = n, side, renew, kind
        self._random = np.random.default_rng(seed)
        self._torch = torch.Generator().manual_seed(seed)
        self._motion: list[Motion | None] = [None] * n
        self._path = [Path() for _ in range(n)]
        shape = (n, 4, side, side)
        self._maps = torch.zeros(n, 3, MAP_SIDE, MAP_SIDE)
        self._seen = torch.zeros(shape)        # output of the photoreceptor, log
        self._reference = torch.zeros(shape)
        self._theta = torch.ones(2, *shape)    # ON, OFF
        self._nominal = torch.ones(2, n, 1, 1, 1)
        self._pixel = torch.zeros(4, n, 1, 1, 1)  # contrast, dark, cutoffs
        self._noise = np.zeros((n, 2))
        self._memory = torch.zeros(n, 4, 2, side, side)
        self._age = np.zeros(n, int)
        self._last = np.zeros((n, 8))
        rows = torch.tensor([p[0] for p in PLACES]).view(4, 1, 1)
        columns = torch.tensor([p[1] for p in PLACES]).view(4, 1, 1)
        middle = side - 0.5
        index = torch.arange(side)
        self._y = (2 * index.view(1, -1, 1) + rows - middle).expand(4, side, side)
        self._x = (2 * index.view(1, 1, -1) + columns - middle).expand(4, side, side)
        self._decay = torch.exp(-1 / torch.tensor(MEMORY)).view(1, 1, 2, 1, 1)

    # ---- the stream ----------------------------------------------------------

    @torch.no_grad()
    def chunk(self, windows: int) -> Chunk:
        """Simulate some windows."""
        fresh = torch.zeros(self.n, dtype=torch.bool)
        for i in range(self.n):
            if self._motion[i] is None or self._random.random() < self.renew:
                self._begin(i)
                fresh[i] = True
        voxels, integrals, ages = [], [], []
        truths: list[Truth] = []
        for _ in range(windows):
            self._age += 1
            grid, truth = self._window()
            self._memory = self._memory * self._decay + UNIT * grid.sum(2)[:, :, None]
            voxels.append(grid)
            integrals.append(self._memory)
            truths.append(truth)
            ages.append(torch.from_numpy(self._age.astype(np.float32)))
        kinds = [m.kind for m in self._motion if m is not None]
        light, log_s0, polar = (torch.stack(part)
                                for part in zip(*truths, strict=True))
        return Chunk(torch.stack(voxels), torch.stack(integrals), light, log_s0, polar,
                     torch.stack(ages), fresh, kinds)

    def state(self) -> Mapping[str, Any]:
        """Return copies of everything that simulating changes."""
        return {name: _copy(value) for name, value in vars(self).items()
                if name.startswith("_") and name not in ("_x", "_y", "_decay")}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore what `state` returned."""
        for name, value in state.items():
            if name == "_random":
                self._random.bit_generator.state = value
            elif name == "_torch":
                self._torch.set_state(value)
            else:
                setattr(self, name, _copy(value))

    # ---- a clip --------------------------------------------------------------

    def _begin(self, i: int) -> None:
        random = self._random
        motion = self._motion[i] = draw_motion(random, self.kind)
        self._path[i] = Path(
            x=MAP_SIDE / 2, y=MAP_SIDE / 2, angle=random.uniform(0, 2 * np.pi),
            zoom=random.uniform(0, 2 * np.pi), phase=random.uniform(0, 2 * np.pi),
            swing=random.uniform(0, 2 * np.pi))
        if motion.kind == "texture":
            self._path[i].x, self._path[i].y = random.uniform(0, MAP_SIDE, 2)
        self._maps[i] = torch.from_numpy(draw_map(random, motion))
        theta = np.exp(random.uniform(np.log(0.08), np.log(0.5)))
        asymmetry = np.exp(random.normal(0, 0.12))
        nominal = np.array((theta * asymmetry, theta / asymmetry))
        known = nominal * np.exp(random.normal(0, 0.06, 2))
        mismatch = random.uniform(0, 0.07)
        spread = torch.randn((2, 4, self.side, self.side), generator=self._torch)
        for p in range(2):
            self._theta[p, i] = float(nominal[p]) * (1 + mismatch * spread[p]).clamp(
                0.6, 1.4)
            self._nominal[p, i] = float(known[p])
        ratio = np.exp(random.uniform(np.log(16), np.log(250)))
        contrast = 1.0 if random.random() < 0.02 else (ratio - 1) / (ratio + 1)
        dark = np.exp(random.uniform(np.log(1e-5), np.log(0.03)))
        slow = random.random()
        cutoff = np.exp(random.uniform(np.log(0.7), np.log(20))) if slow < 0.5 else 1e3
        share = random.random() if slow < 0.25 else 0.0  # proportional to the light
        for p, value in enumerate((contrast, dark, cutoff * (1 - share),
                                   cutoff * share)):
            self._pixel[p, i] = float(value)
        quiet = random.random() < 0.4
        self._noise[i] = (0, 0) if quiet else (
            np.exp(random.uniform(np.log(1e-4), np.log(0.02))),
            0.01 * random.random() ** 2)
        self._age[i] = 0
        self._memory[i] = 0
        # The first node is the position before the path moves.
        self._last[i] = walk(random, _still(motion), self._path[i], 1)[0]
        light = self._light(*self._look(self._last[:, None], [i]), [i])[0]
        level = torch.log(light + self._pixel[1, [i]])
        self._seen[i] = level[0]
        start = torch.rand(level[0].shape, generator=self._torch)
        self._reference[i] = level[0] + self._theta[1, i] - start * (
            self._theta[0, i] + self._theta[1, i])

    def _look(self, nodes: np.ndarray, which: list[int] | None = None,
              ) -> tuple[torch.Tensor, torch.Tensor]:
        """Sample the maps at nodes; return (K, n, 3, 4, H, W) and (K, n, 2, 2)."""
        if which is not None:
            nodes = nodes[which]
        maps = self._maps if which is None else self._maps[which]
        n, k = nodes.shape[:2]
        at = torch.from_numpy(nodes.astype(np.float32))
        c, s = (torch.cos(at[..., 2]) * at[..., 3], torch.sin(at[..., 2]) * at[..., 3])
        c, s, x0, y0 = (v.view(n, k, 1, 1, 1) for v in (c, s, at[..., 0], at[..., 1]))
        # The scene turns counter-clockwise if positions are looked up clockwise.
        u = x0 + c * self._x - s * self._y
        v = y0 + s * self._x + c * self._y
        scale = 2 / (MAP_SIDE - 1)
        grid = torch.stack((u * scale - 1, v * scale - 1), -1)
        side = self.side
        seen = F.grid_sample(maps, grid.view(n, k * 4 * side, side, 2),
                             padding_mode="reflection", align_corners=True)
        seen = seen.view(n, 3, k, 4, side, side).permute(2, 0, 1, 3, 4, 5)
        return seen, at[..., 4:].view(n, k, 2, 2).transpose(0, 1)

    def _light(self, seen: torch.Tensor, passing: torch.Tensor,
               which: list[int] | None = None) -> torch.Tensor:
        """Return the light on each pixel, (K, n, 4, H, W)."""
        contrast = self._pixel[0] if which is None else self._pixel[0, which]
        k, n = seen.shape[:2]
        m = passing.reshape(k, n, 2, 2, 1, 1)
        light, s1, s2 = seen.unbind(2)
        out = torch.empty_like(light)
        for c, (row, sign) in enumerate(((0, 1), (1, 1), (0, -1), (1, -1))):
            out[:, :, c] = sign * (m[:, :, row, 0] * s1[:, :, c]
                                   + m[:, :, row, 1] * s2[:, :, c])
        return torch.exp(light) * (0.5 + 0.5 * contrast * out)

    def _window(self) -> tuple[torch.Tensor, Truth]:
        nodes = np.stack([walk(self._random, m, p, STEPS) for m, p in
                          zip(self._motion, self._path, strict=True)
                          if m is not None])
        # Maps are sampled at every second node and interpolated between; the
        # matrix of the polarization is known at every node.
        whole = np.concatenate((self._last[:, None], nodes), 1)
        seen, _ = self._look(whole[:, ::2])
        passing = torch.from_numpy(
            nodes[..., 4:].astype(np.float32)).view(self.n, STEPS, 2, 2).transpose(0, 1)
        between = (seen[:-1] + seen[1:]) / 2
        seen = torch.stack((between, seen[1:]), 1).flatten(0, 1)
        self._last = nodes[:, -1]
        lights = self._light(seen, passing)
        dark, fixed, follows = self._pixel[1:]
        level = torch.log(lights + dark)
        # Clamped, as the exponential of a long step is 0 anyway.
        gain = -torch.expm1(-(fixed + follows * lights).clamp(max=80) / STEPS)
        grid = torch.zeros(self.n, 4, BINS, self.side, self.side)
        leak = torch.from_numpy(self._noise[:, 1].astype(np.float32)).view(-1, 1, 1, 1)
        leak = leak * self._theta[0] / STEPS
        ratio = self._nominal / UNIT
        for i in range(STEPS):
            before = self._seen
            now = before + gain[i] * (level[i] - before)
            self._reference = self._reference - leak
            ahead = now - self._reference
            up = ahead > 0
            step = torch.where(up, self._theta[0], -self._theta[1])
            count = torch.floor(ahead / step)
            moved = now - before
            moved = torch.where(moved.abs() < 1e-6, 1e-6, moved)
            late = (count * (self._reference - before)
                    + step * (count * (count + 1) / 2)) / moved
            late = torch.minimum(late.clamp(min=0), count)
            value = torch.where(up, ratio[0], -ratio[1])
            second = (count * (i % 2) + late) / 2
            grid[:, :, i // 2] += value * (count - second)
            grid[:, :, i // 2 + 1] += value * second
            self._reference = self._reference + count * step
            self._seen = now
        self._add_noise(grid, ratio)
        m = passing[-1].view(self.n, 2, 2, 1, 1)
        s1, s2 = (part.mean(1) for part in seen[-1, :, 1:].unbind(1))
        polar = self._pixel[0] * torch.stack(
            (m[:, 0, 0] * s1 + m[:, 0, 1] * s2, m[:, 1, 0] * s1 + m[:, 1, 1] * s2), 1)
        return grid, (lights[-1], seen[-1, :, 0], polar)

    def _add_noise(self, grid: torch.Tensor, ratio: torch.Tensor) -> None:
        """Add noise events, which move the comparator's reference."""
        random, cells = self._random, 4 * self.side * self.side
        for i in range(self.n):
            n = random.poisson(self._noise[i, 0] * cells)
            if not n:
                continue
            where = torch.from_numpy(random.integers(0, cells, n))
            up = torch.from_numpy(random.random(n) < 0.5)
            value = torch.where(up, ratio[0, i].flatten(), -ratio[1, i].flatten())
            bins = torch.from_numpy(random.integers(0, BINS, n))
            area = self.side * self.side
            place = (where // area * BINS + bins) * area + where % area
            grid[i].view(-1).index_add_(0, place, value)
            self._reference[i].view(-1)[where] = self._seen[i].view(-1)[where]


def _still(motion: Motion) -> Motion:
    return replace(motion, velocity=np.zeros(2), turn=0.0, zoom_rate=0.0, spin=0.0,
                   swing=0.0, pause=0.0, redraw=0.0)


def _copy(value: Any) -> Any:
    if isinstance(value, torch.Generator):
        return value.get_state()
    if isinstance(value, np.random.Generator):
        return copy.deepcopy(value.bit_generator.state)
    return copy.deepcopy(value)
