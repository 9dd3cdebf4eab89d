"""The recurrent networks in torch, for training."""
from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn

WIDTH = 16
"""Planes of each hidden layer."""


class ConvGru(nn.Module):
    """Gated recurrent cell; its update gate multiplies the new value."""

    def __init__(self) -> None:
        super().__init__()
        self.gates = nn.Conv2d(2 * WIDTH, 2 * WIDTH, 3, padding=1)
        self.new = nn.Conv2d(2 * WIDTH, WIDTH, 3, padding=1)

    def forward(self, x: torch.Tensor, h: torch.Tensor) -> torch.Tensor:
        """Return the next state."""
        z, r = torch.sigmoid(self.gates(torch.cat((x, h), 1))).chunk(2, 1)
        new = torch.tanh(self.new(torch.cat((x, r * h), 1)))
        return h + z * (new - h)


class Residual(nn.Module):
    """Residual block of two convolutions."""

    def __init__(self) -> None:
        super().__init__()
        self.a = nn.Conv2d(WIDTH, WIDTH, 3, padding=1)
        self.b = nn.Conv2d(WIDTH, WIDTH, 3, padding=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the block's output."""
        return F.relu(x + self.b(F.relu(self.a(x))))


class Network(nn.Module):
    """Head, two cells each followed by a residual block, and a 1x1 prediction.

    Parameters
    ----------
    inputs, outputs : int
        Number of input and output planes.
    direct : int
        Number of last input planes that are fed to the prediction directly.
    """

    def __init__(self, inputs: int, outputs: int, direct: int = 0) -> None:
        super().__init__()
        self.direct = direct
        self.head = nn.Conv2d(inputs, WIDTH, 3, padding=1)
        self.g1, self.r1 = ConvGru(), Residual()
        self.g2, self.r2 = ConvGru(), Residual()
        self.pred = nn.Conv2d(WIDTH + direct, outputs, 1)

    def forward(
        self, x: torch.Tensor, h1: torch.Tensor, h2: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Advance by one window; return (log intensity, h1, h2)."""
        y = F.relu(self.head(x))
        h1 = self.g1(y, h1)
        h2 = self.g2(self.r1(h1), h2)
        y = self.r2(h2)
        with torch.autocast("cpu", enabled=False):
            y = y.float()
            if self.direct:
                y = torch.cat((y, x[:, -self.direct:]), 1)
            return self.pred(y), h1, h2
