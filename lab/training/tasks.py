"""What each network takes and returns, and what it is trained for."""
from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
from torch import nn

from .clips import Chunk
from .networks import WIDTH, Network

DARKEST = 1e-2
"""Intensity below which a channel counts as dark, where mean S0 is 1."""


class Task(ABC):
    """A network's inputs, the meaning of its outputs, and its own part of the loss.

    Attributes
    ----------
    runs : int
        How often the network runs side by side on one clip: once per channel, or once.
    """

    runs: int

    @abstractmethod
    def network(self) -> Network:
        """Make the network with initial weights."""

    @abstractmethod
    def inputs(self, chunk: Chunk) -> torch.Tensor:
        """Return the network's inputs, shape (K, runs * clips, C, H, W)."""

    @abstractmethod
    def measured(self, outputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return ln S0 at each pixel, or of each cell, and S1/S0 and S2/S0."""

    @abstractmethod
    def true_s0(self, log_s0: torch.Tensor) -> torch.Tensor:
        """Return the true ln S0 where `measured` has it, from that of each pixel."""

    @abstractmethod
    def own_loss(
        self, outputs: torch.Tensor, chunk: Chunk, true_s0: torch.Tensor,
        gain: torch.Tensor, weight: torch.Tensor,
    ) -> torch.Tensor:
        """Return what is added to the loss that both networks share.

        Parameters
        ----------
        outputs : Tensor
            Of the network.
        chunk : Chunk
            What it was given, and the truth.
        true_s0 : Tensor
            True ln S0.
        gain : Tensor
            Mean error of ln S0 of each clip.
        weight : Tensor
            Weight of each window, 1 on average.
        """


class OneChannel(Task):
    """``firenet`` maps the bins of one channel to its intensity."""

    runs = 4

    def network(self) -> Network:
        """Make the network with initial weights."""
        net = Network(5, 1)
        bias = net.pred.bias
        assert bias is not None
        nn.init.constant_(bias, 0.5)
        return net

    def inputs(self, chunk: Chunk) -> torch.Tensor:
        """Return the bins of each channel."""
        k, n, _, bins, h, w = chunk.voxels.shape
        return chunk.voxels.reshape(k, n * 4, bins, h, w)

    def measured(self, outputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return ln S0 of each cell, and S1/S0 and S2/S0, of four intensities."""
        i0, i45, i90, i135 = outputs.clamp(min=DARKEST).unbind(2)
        s0 = (i0 + i45 + i90 + i135) / 2
        polar = torch.stack(((i0 - i90) / s0, (i45 - i135) / s0), 2)
        return torch.log(s0)[:, :, None], polar

    def true_s0(self, log_s0: torch.Tensor) -> torch.Tensor:
        """Return the mean of the cell's four pixels."""
        return torch.logsumexp(log_s0, 2, keepdim=True) - math.log(4)

    def own_loss(
        self, outputs: torch.Tensor, chunk: Chunk, true_s0: torch.Tensor,
        gain: torch.Tensor, weight: torch.Tensor,
    ) -> torch.Tensor:
        """Return half of the mean absolute error of intensity, relative to mean S0."""
        mean = torch.exp(true_s0).mean((0, 2, 3, 4), keepdim=True)
        return ((outputs - chunk.light / mean).abs() * weight).mean() / 2


class FourChannels(Task):
    """``joint`` maps bins and integrals of all channels to ln S0, S1/S0 and S2/S0.

    It returns ln S0 at each of the four pixels, as corrections of their slow integrals.
    """

    runs = 1

    def network(self) -> Network:
        """Make the network with initial weights."""
        net = Network(28, 6, direct=8)
        with torch.no_grad():
            net.pred.weight[:, WIDTH:] = 0
            for c in range(4):
                net.pred.weight[c, WIDTH + 1::2] = 0.1
                net.pred.weight[c, WIDTH + 2 * c + 1] = 0.5
            nn.init.zeros_(net.pred.bias)  # type: ignore[arg-type]
        return net

    def inputs(self, chunk: Chunk) -> torch.Tensor:
        """Return the bins and the integrals of all channels."""
        k, n, _, bins, h, w = chunk.voxels.shape
        return torch.cat((chunk.voxels.reshape(k, n, 4 * bins, h, w),
                          chunk.integrals.reshape(k, n, 8, h, w)), 2)

    def measured(self, outputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return ln S0 at each pixel, and S1/S0 and S2/S0."""
        return outputs[:, :, :4], outputs[:, :, 4:]

    def true_s0(self, log_s0: torch.Tensor) -> torch.Tensor:
        """Return that of each pixel."""
        return log_s0

    def own_loss(
        self, outputs: torch.Tensor, chunk: Chunk, true_s0: torch.Tensor,
        gain: torch.Tensor, weight: torch.Tensor,
    ) -> torch.Tensor:
        """Return a hundredth of the mean error of ln S0 that a clip has in common."""
        return 0.01 * gain.abs().mean()


_TASKS: dict[str, Task] = {"firenet": OneChannel(), "joint": FourChannels()}


def task_of(network: str) -> Task:
    """Return the task of a network.

    Raises
    ------
    ValueError
        If there is no such network.
    """
    if network not in _TASKS:
        raise ValueError(f"network must be one of {sorted(_TASKS)}, got {network!r}")
    return _TASKS[network]
