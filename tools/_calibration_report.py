"""Report with figures and numbers for one part of a calibration."""
from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._beside import write_beside
from pdavis_cv._text import drawn
from pdavis_cv._types import Image

from ._common import can_draw


@dataclass
class Page:
    """The content of a report.

    `lines` are ``"what: value"``, printed and stored in the calibration's notes;
    `figures` (kind, title, data).
    """

    title: str
    lines: list[str] = field(default_factory=list)
    figures: list[tuple[str, str, Any]] = field(default_factory=list)

    def say(self, what: str, value: object) -> None:
        """Add a line."""
        self.lines.append(f"{what}: {value}")

    def image(self, title: str, plane: Image) -> None:
        """Add a map of the sensor."""
        self.figures.append(("image", title, plane))

    def histogram(
        self, title: str, values: NDArray[Any], *, logarithmic: bool = False
    ) -> None:
        """Add a histogram."""
        kind = "log histogram" if logarithmic else "histogram"
        self.figures.append((kind, title, np.ravel(values)))


def write_report(path: Path, page: Page) -> bool:
    """Draw the page as PNG; print a message and return False without matplotlib."""
    if not can_draw():
        return False
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    figure = Figure(figsize=(8.3, 11.7), layout="constrained")
    FigureCanvasAgg(figure)
    parts: Any = figure.subfigures(
        3, 1, height_ratios=[0.25 + 0.16 * len(page.lines), 3.2, 3.2])
    text, *rest = parts
    text.suptitle(drawn(page.title), fontsize=16)
    text.text(0.05, 0.8, "\n".join(map(drawn, page.lines)), va="top", fontsize=10,
              family="monospace", wrap=True)
    for row, start in zip(rest, (0, 2), strict=True):
        figures = page.figures[start:start + 2]
        if figures:
            axes = row.subplots(1, len(figures), squeeze=False)[0]
            for axis, (kind, title, data) in zip(axes, figures, strict=True):
                _draw(axis, kind, data)
                axis.set_title(title, fontsize=11)
                if kind == "image":
                    row.colorbar(axis.images[0], ax=axis, shrink=0.8)
    with write_beside(path) as part:
        figure.savefig(part, format="png", dpi=110)
    return True


def _draw(axis: Any, kind: str, data: Any) -> None:
    if kind == "image":
        finite = data[np.isfinite(data)]
        low, high = np.percentile(finite, (1, 99)) if finite.size else (0, 1)
        axis.imshow(data, vmin=low, vmax=high, interpolation="nearest")
    else:
        finite = data[np.isfinite(data)]
        low, high = np.percentile(finite, (0.1, 99.9)) if finite.size else (0, 1)
        axis.hist(finite, bins=80, range=(low, high) if high > low else None,
                  log=kind.startswith("log"))
        axis.set_ylabel("samples")
