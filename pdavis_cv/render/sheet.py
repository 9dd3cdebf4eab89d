"""Sheets of panels of which only the pictures and the title change."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pdavis_cv.render.colours import (
    LINE,
    Picture,
    _text_width,
    caption,
    panel,
    tile,
)

__all__ = ["Panel", "PanelSheet"]

_GAP = 8


@dataclass(frozen=True)
class Panel:
    """What stands around a picture; see `panel`."""

    title: str
    legend: str | None = None
    start: str = "0"
    end: str = "1"


class PanelSheet:
    """Makes what `tile` makes of what `panel` makes, in a memory that is kept.

    Fresh memory for each picture of a video would take several times as long as
    drawing into it.

    Parameters
    ----------
    panels : sequence of Panel
        In the order of the pictures.
    columns : int
        How many stand in a row.
    scale : int
        Each pixel of a picture becomes a square of this side.
    """

    def __init__(
        self, panels: Sequence[Panel], *, columns: int, scale: int = 1
    ) -> None:
        self.panels, self.columns, self.scale = tuple(panels), columns, scale
        self._sheet: Picture | None = None
        self._slots: list[Picture] = []
        self._sizes: list[tuple[int, ...]] = []
        self._width = 0

    @property
    def places(self) -> Sequence[Picture | None]:
        """Where the pictures stand in the sheet.

        A picture made in its place need not be copied there.  None before the first
        sheet, and where each pixel becomes several.
        """
        if self._slots and self.scale == 1:
            return self._slots
        return (None,) * len(self.panels)

    def draw(self, pictures: Sequence[Picture], title: str) -> Picture:
        """Compose a sheet.

        Parameters
        ----------
        pictures : sequence of ndarray of uint8, shape (H, W, 3)
            BGR, one per panel; each may have been drawn into its of `places`.
        title : str
            One line over all of them.

        Returns
        -------
        ndarray of uint8, shape (H', W', 3)
            BGR of even size; the next call writes into it again.
        """
        sizes = [picture.shape for picture in pictures]
        width = max(_text_width(title) + 8, self._width)
        if self._sheet is None or not title or sizes != self._sizes or (
                width + width % 2 != self._sheet.shape[1]):
            return self._composed(pictures, title)
        self._sheet[:LINE] = 0
        caption(self._sheet, title, 4, 14)
        step = self.scale
        for slot, picture in zip(self._slots, pictures, strict=True):
            if picture is slot:
                continue
            for down in range(step):
                for right in range(step):
                    slot[down::step, right::step] = picture
        return self._sheet

    def _composed(self, pictures: Sequence[Picture], title: str) -> Picture:
        panels = [
            panel(picture, each.title, legend=each.legend, start=each.start,
                  end=each.end, scale=self.scale)
            for picture, each in zip(pictures, self.panels, strict=True)]
        sheet = tile(panels, columns=self.columns, title=title, gap=_GAP)
        if not title:
            return sheet
        self._sheet, self._slots = sheet, []
        self._sizes = [picture.shape for picture in pictures]
        height = max(part.shape[0] for part in panels) + _GAP
        width = max(part.shape[1] for part in panels) + _GAP
        self._width = min(self.columns, len(panels)) * width + _GAP
        for i, (part, picture) in enumerate(zip(panels, pictures, strict=True)):
            row, column = divmod(i, min(self.columns, len(panels)))
            top = LINE + _GAP + row * height + LINE
            left = _GAP + column * width + (width - _GAP - part.shape[1]) // 2
            self._slots.append(sheet[top:top + picture.shape[0] * self.scale,
                                     left:left + picture.shape[1] * self.scale])
        return sheet
