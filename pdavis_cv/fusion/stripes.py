"""One recording by several workers: stripes of the sensor, joined to the same bits."""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from pdavis_cv.fusion.engine import Fusion
from pdavis_cv.fusion.images import Samples
from pdavis_cv.fusion.learning import Tuning
from pdavis_cv.fusion.options import FusionOptions
from pdavis_cv.fusion.snapshot import FusionSnapshot
from pdavis_cv.fusion.window import Roi
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.reconstruct.base import WHOLE_SENSOR
from pdavis_cv.recording.base import Recording, Source

__all__ = ["fuse_tiles", "tiles"]

_IMAGES = 64
"""In a piece of work: its state is handed on after it.  With fewer that costs more than
a few percent, with more the images of several stripes take more memory."""


def tiles(shape: tuple[int, int], n: int) -> tuple[Roi, ...]:
    """Divide a sensor into stripes of whole polarizer cells.

    Parameters
    ----------
    shape : (int, int)
        (height, width) of the sensor.
    n : int
        How many; fewer where there are fewer rows of cells.

    Returns
    -------
    tuple of (int, int, int, int)
        Each is the ``roi`` of a stripe, (x, y, width, height), from top to bottom.
        What `fuse` gives for it is that part of the whole result; it computes as many
        rows around it as the method and demosaicing need.

    Raises
    ------
    ValueError
        If `n` is not positive.

    Examples
    --------
    >>> tiles((260, 346), 2)
    ((0, 0, 346, 130), (0, 130, 346, 130))
    """
    return _stripes((0, 0, shape[1], shape[0]), n)


def _stripes(roi: Roi, n: int) -> tuple[Roi, ...]:
    if n < 1:
        raise ValueError(f"n must be positive, got {n}")
    x, y, width, height = roi
    n = min(n, max(height // 2, 1))
    edges = [height // 2 * i // n * 2 for i in range(n)] + [height]
    return tuple((x, y + top, width, bottom - top)
                 for top, bottom in pairwise(edges))


@dataclass(frozen=True, eq=False)
class _Piece:
    """Some images of a stripe, and the state before them."""

    recording: Recording
    options: FusionOptions
    tuning: Tuning
    before: FusionSnapshot | None


class _Sampled(NamedTuple):
    """Samples of a stripe at a time; None where they are those of the image before."""

    t_us: int
    frame_us: int | None
    samples: Samples | None


def _work(piece: _Piece) -> tuple[list[_Sampled], FusionSnapshot]:
    """Return the samples of a piece, fewer at the end, and the state after them."""
    fusion = Fusion(piece.recording, piece.options)
    fusion.learned(piece.tuning)
    if piece.before is not None:
        fusion.restore(piece.before)
    found: list[_Sampled] = []
    last: object | None = None
    while len(found) < _IMAGES and fusion.advance():
        shown, samples = fusion.samples()
        same = shown is not None and shown is last
        assert fusion.t_us is not None
        found.append(_Sampled(
            fusion.t_us, fusion.frame_us(), None if same else samples))
        last = shown
    return found, fusion.snapshot()


def fuse_tiles(
    recording: Source, options: FusionOptions, executor: Executor, n: int
) -> Iterator[PolarFrame]:
    """Yield what `fuse` yields, made by an executor from n stripes.

    What must be learned of the recording is learned here, once, and handed on.

    Parameters
    ----------
    recording : Recording
        Pickles, and can be read where the executor works: a file, whose path is sent.
    options : FusionOptions
    executor : Executor
    n : int
        How many stripes.

    Raises
    ------
    TypeError
        If the source can be read only once.
    ValueError
        If the method's pixels depend on all others.
    """
    if not isinstance(recording, Recording):
        raise TypeError("executor needs a Recording, which each worker can read, got "
                        f"{type(recording).__name__}")
    whole = Fusion(recording, options)
    if whole.margin >= WHOLE_SENSOR:
        raise ValueError(
            f"executor needs a method whose pixels depend on a neighbourhood; each one "
            f"of {whole.method} depends on all others (threads= shares its rows)")
    rows, columns = whole.window.rows, whole.window.columns
    height, width = whole.window.shape
    return _joined(whole, recording, executor, _stripes(
        (columns.start, rows.start, width, height), n))


def _joined(
    whole: Fusion, recording: Recording, executor: Executor, stripes: Sequence[Roi]
) -> Iterator[PolarFrame]:
    tuning = whole.learned()

    # Stripes are not demosaiced, so they may have an odd side at the sensor's edge.
    options = whole.options.replace(demosaic="bilinear")

    def submit(
        stripe: Roi, before: FusionSnapshot | None
    ) -> Future[tuple[list[_Sampled], FusionSnapshot]]:
        return executor.submit(_work, _Piece(
            recording, options.replace(roi=stripe), tuning, before))

    waiting = [submit(stripe, None) for stripe in stripes]
    image: PolarFrame | None = None
    try:
        while waiting:
            pieces = [future.result() for future in waiting]
            ended = len(pieces[0][0]) < _IMAGES
            waiting = [] if ended else [
                submit(stripe, after)
                for stripe, (_, after) in zip(stripes, pieces, strict=True)]
            for parts in zip(*(found for found, _ in pieces), strict=True):
                t_us, frame_us, _ = parts[0]
                planes = [part.samples for part in parts if part.samples is not None]
                if planes:
                    image = whole.made(Samples.stacked(planes), t_us, frame_us)
                else:
                    assert image is not None
                    image = image.retimed(t_us, frame_us, whole.provenance)
                yield image
    finally:
        for future in waiting:
            future.cancel()
