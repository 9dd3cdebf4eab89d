"""Sheets of panels in which only the pictures and the title change."""
from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pdavis_cv.render.colours import Picture
from pdavis_cv.render.legends import (
    DARK,
    LINE,
    Style,
    caption,
    panel,
    tile,
)

__all__ = ["Panel", "PanelSheet"]

_GAP = 8


@dataclass(frozen=True)
class Panel:
    """Title and legend of a picture; see `panel`."""

    title: str
    legend: str | None = None
    start: str = "0"
    end: str = ""


class PanelSheet:
    """Draw the sheets that `tile` makes of panels, but reuse memory.

    Allocating memory for each picture of a video would take several times as long as
    drawing it.

    Parameters
    ----------
    panels : sequence of Panel
        One per picture, in the same order.
    columns : int
        Number of panels per row.
    scale : int
        Each pixel of a picture becomes a square of this side.
    keep : int
        Number of sheets that remain unchanged, including the last one.
    style : Style
        `DARK` or `LIGHT`.
    mark : callable, optional
        Draws into each enlarged picture in the sheet; for sheets with a title.
    """

    def __init__(
        self, panels: Sequence[Panel], *, columns: int, scale: int = 1, keep: int = 1,
        style: Style = DARK, mark: Callable[[Picture], None] | None = None,
    ) -> None:
        self.panels, self.columns, self.scale = tuple(panels), columns, scale
        self.keep, self.style, self.mark = keep, style, mark
        # Sheets and the views of their pictures, the next one first.
        self._ring: deque[tuple[Picture, list[Picture]]] = deque()
        self._sizes: list[tuple[int, ...]] = []

    @property
    def places(self) -> Sequence[Picture | None]:
        """Views of the pictures in the next sheet.

        A picture drawn into its view need not be copied.  None before the first sheet,
        and if pictures are enlarged.
        """
        if self._ring and self.scale == 1:
            return self._ring[0][1]
        return (None,) * len(self.panels)

    def draw(self, pictures: Sequence[Picture], title: str) -> Picture:
        """Compose a sheet.

        Parameters
        ----------
        pictures : sequence of ndarray of uint8, shape (H, W, 3)
            BGR, one per panel; each may have been drawn into its view from `places`.
        title : str
            One line above all pictures.

        Returns
        -------
        ndarray of uint8, shape (H', W', 3)
            BGR of even size; the `keep`-th call after this one overwrites it.
        """
        sizes = [picture.shape for picture in pictures]
        # The pictures of a video have one size: a title that grows is cut at the edge.
        if not title or not self._ring or sizes != self._sizes:
            return self._composed(pictures, title)
        sheet, slots = self._ring[0]
        zoom = self.style.zoom
        sheet[:LINE * zoom] = self.style.ground
        caption(sheet, title, 4 * zoom, 14 * zoom, self.style.ink, zoom)
        step = self.scale
        for slot, picture in zip(slots, pictures, strict=True):
            if picture is not slot:
                for down in range(step):
                    for right in range(step):
                        slot[down::step, right::step] = picture
            if self.mark is not None:
                self.mark(slot)
        self._ring.rotate(-1)
        return sheet

    def _composed(self, pictures: Sequence[Picture], title: str) -> Picture:
        panels = [
            panel(picture, each.title, legend=each.legend, start=each.start,
                  end=each.end, scale=self.scale, style=self.style)
            for picture, each in zip(pictures, self.panels, strict=True)]
        sheet = tile(panels, columns=self.columns, title=title, gap=_GAP,
                     style=self.style)
        if not title:
            return sheet
        self._sizes = [picture.shape for picture in pictures]
        line, gap = LINE * self.style.zoom, _GAP * self.style.zoom
        height = max(part.shape[0] for part in panels) + gap
        width = max(part.shape[1] for part in panels) + gap
        corners = []
        for i, part in enumerate(panels):
            row, column = divmod(i, min(self.columns, len(panels)))
            corners.append((
                line + gap + row * height + line,
                gap + column * width + (width - gap - part.shape[1]) // 2))
        self._ring.clear()
        for kept in (sheet, *(sheet.copy() for _ in range(self.keep - 1))):
            self._ring.append((kept, [
                kept[top:top + picture.shape[0] * self.scale,
                     left:left + picture.shape[1] * self.scale]
                for (top, left), picture in zip(corners, pictures, strict=True)]))
        if self.mark is not None:
            for slot in self._ring[0][1]:
                self.mark(slot)
        self._ring.rotate(-1)
        return sheet
