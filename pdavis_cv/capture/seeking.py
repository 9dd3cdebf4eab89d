"""Exact repositioning among the images of a Fusion."""
from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.fusion import Fusion, FusionSnapshot
from pdavis_cv.fusion.grid import grid_count
from pdavis_cv.fusion.turning import TurningFusion
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.reconstruct.base import nbytes
from pdavis_cv.recording.base import Recording

SPACING_US = 2_000_000
"""Recording time between two snapshots, before any are dropped, us."""

MOST_SNAPSHOTS = 64
MOST_BYTES = 256 * 2**20


@dataclass(frozen=True, eq=False)
class Bookmark:
    """A position between two images to which a Cursor can return; picklable.

    `previous_us` is the time of the image before the last one.
    """

    snapshot: FusionSnapshot
    previous_us: int | None


class Cursor:
    """A position among the images of a Fusion, which can be moved to any other.

    After any movement the state has the same bits as after reading all images up to
    there.  To go back, the last snapshot before the position is restored, and the
    recording is replayed from it without making images.  A snapshot is taken every 2 s
    of recording time.  At most 64 snapshots of at most 256 MiB together are kept;
    beyond that every second one is dropped and the interval doubles.

    The fusion is of a Recording, at its beginning; from now on only the Cursor may use
    it.
    """

    fusion: Fusion | TurningFusion

    def __init__(self, fusion: Fusion | TurningFusion) -> None:
        if not isinstance(fusion.recording, Recording):
            raise TypeError(
                "a position needs a Recording, got a Source that is read once")
        self.fusion, self._recording = fusion, fusion.recording
        self.previous_us: int | None = None
        self.spacing_us = SPACING_US
        self._kept: list[Bookmark] = []
        self._times: NDArray[np.int64] | None = None
        self._count: int | None = None

    @property
    def index(self) -> int:
        """Number of the next image."""
        return self.fusion.index

    @property
    def t_us(self) -> int | None:
        """Time of the last image, None before the first."""
        return self.fusion.t_us

    @property
    def kept(self) -> tuple[int, ...]:
        """Positions for which a snapshot is kept."""
        return tuple(mark.snapshot.index for mark in self._kept)

    def advance(self) -> bool:
        """Move past the next image; return False at the end."""
        before = self.fusion.t_us
        if not self.fusion.advance():
            return False
        self.previous_us = before
        self._keep()
        return True

    def image(self) -> PolarFrame:
        """Return the image that `advance` has just passed."""
        return self.fusion.image()

    # ---- movement ------------------------------------------------------------

    def seek(self, index: int) -> int:
        """Move to image number index, clamped to 0 .. their number, and return it."""
        index = max(index, 0)
        place = bisect_right(self.kept, index) - 1
        known = self._kept[place] if place >= 0 else None
        if index < self.index:
            if known is None:
                self.rewind()
            else:
                self.restore(known)
        elif known is not None and known.snapshot.index > self.index:
            self.restore(known)
        while self.index < index and self.advance():
            pass
        return self.index

    def rewind(self) -> None:
        """Return to the position before the first image."""
        self.fusion.rewind()
        self.previous_us = None

    def bookmark(self) -> Bookmark:
        """Return the position; an equal Cursor can `restore` it."""
        return Bookmark(self.fusion.snapshot(), self.previous_us)

    def restore(self, mark: Bookmark) -> None:
        """Move to a bookmark."""
        self.fusion.restore(mark.snapshot)
        self.previous_us = mark.previous_us

    def _keep(self) -> None:
        t = self.fusion.t_us
        last = self._kept[-1].snapshot.t_us if self._kept else self.fusion.start_us
        if t is None or last is None or t - last < self.spacing_us:
            return
        # The next snapshot will be about as large as the last: make room for it.
        self._thin(MOST_BYTES - nbytes(self._kept[-1:]))
        self._kept.append(self.bookmark())
        self._thin(MOST_BYTES)

    def _thin(self, most_bytes: int) -> None:
        while len(self._kept) > 1 and (
                len(self._kept) > MOST_SNAPSHOTS or nbytes(self._kept) > most_bytes):
            del self._kept[::2]
            self.spacing_us *= 2

    # ---- the whole grid --------------------------------------------------------

    @property
    def count(self) -> int:
        """Number of images; this reads the recording once if it has no index."""
        if self._count is None:
            self._count = self._counted()
        return self._count

    @property
    def fps(self) -> float:
        """Images per second of the grid, or the mean rate if it is not regular."""
        if self.fusion.fps is not None:
            return float(self.fusion.fps)
        times = self.times_us
        if len(times) < 2:
            return 0.0
        return (len(times) - 1) * 1e6 / float(times[-1] - times[0])

    @property
    def times_us(self) -> NDArray[np.int64]:
        """Times of the images, if they are not on a regular grid."""
        if self._times is None:
            given = self.fusion.times_us
            self._times = self._frame_times() if given is None else given
        return self._times

    def index_at(self, t_us: float) -> int:
        """Return the number of the image nearest to a time; of two, the later one."""
        rate, start = self.fusion.fps, self.fusion.start_us
        if rate is not None:
            if start is None:
                return 0
            after = Fraction(t_us) - start
            return max(0, int((after * rate / 1_000_000 + Fraction(1, 2)) // 1))
        times = self.times_us
        if not len(times):
            return 0
        after_last = 2 * int(times[-1]) - (int(times[-2]) if len(times) > 1 else 0)
        if t_us >= after_last:
            return len(times)
        middles = times[:-1] + np.diff(times) / 2
        return int(np.searchsorted(middles, t_us, "right"))

    def _counted(self) -> int:
        rate, start = self.fusion.fps, self.fusion.start_us
        if rate is None:
            return len(self.times_us)
        if start is None:
            return 0
        last = self._recording.info.stop_us
        if last is None:
            last = self._recording.scan().stop_us
        stops = [stop for stop in (last, self.fusion.stop_us) if stop is not None]
        return grid_count(min(stops) - start, rate) if stops else 0

    def _frame_times(self) -> NDArray[np.int64]:
        start = self.fusion.start_us
        stop = self.fusion.stop_us
        times = [frame.mid_us for packet in self._recording.packets()
                 for frame in packet.frames]
        return np.array([t for t in sorted(set(times))
                         if (start is None or t >= start)
                         and (stop is None or t < stop)], np.int64)
