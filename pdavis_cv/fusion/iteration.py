"""fuse(): iterate over the images of a recording, in one thread or in two."""
from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from pdavis_cv.fusion.engine import Fusion
from pdavis_cv.fusion.options import FusionOptions, takes_options
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.recording.base import Recording, Source

__all__ = ["ReadAhead", "fuse"]

DEPTH = 2
"""Images that are read before the first of them is returned: one to work on while the
next is read.  A deeper queue gains nothing, as what waits leaves the caches."""


@takes_options
def fuse(
    recording: Source, options: FusionOptions | None = None, **changes: Any
) -> Iterator[PolarFrame]:
    """Fuse a recording's frames and events into polarization images.

    Reading begins when the first image is asked for.  Without `fps` and `times_us`
    there is one image per frame, at its mid-exposure (100 per second if there are no
    frames).  The recording is always processed from its beginning, whatever `start_us`
    is, so an image does not depend on which other images are asked for.

    Parameters
    ----------
    recording : Recording or Source
        From `open_recording` or `recording_from_arrays`; or a source that can be read
        only once, e.g. from `source_from_packets`, which is processed in one pass and
        bounded memory.  Without `causal`, the first image of such a source may have to
        wait for its first 10 s, from which parameters of the camera are estimated.
    options : FusionOptions, optional
        Options to start from; the keywords below override them.
    {options}
    **method_parameters
        Parameters of the method, e.g. ``cutoff_hz`` for ``cf``.

    Returns
    -------
    iterator of PolarFrame
        With `threads` above 1, it reads a recording one image ahead.

    Raises
    ------
    TypeError
        If an argument has the wrong type or the method has no such parameter.
    ValueError
        If a value is out of range, e.g. a region that leaves the sensor.
    LayoutError, CalibrationError
        If layouts disagree, or the calibration belongs to another camera.

    Examples
    --------
    >>> import pdavis_cv
    >>> from pdavis_cv.data import example_recording
    >>> options = pdavis_cv.FusionOptions(method="cf", layout=pdavis_cv.Layout.PDAVIS)
    >>> with pdavis_cv.open_recording(example_recording()) as recording:
    ...     image = next(pdavis_cv.fuse(recording, options, roi=(0, 0, 40, 30)))
    >>> image.dolp.shape
    (30, 40)
    """
    fusion = Fusion(recording, options, **changes)
    whole = fusion.options.threads > 1 and isinstance(recording, Recording)
    return ReadAhead(fusion) if whole else fusion


class ReadAhead(Iterator[PolarFrame]):
    """Iterate over a Fusion's images, which are the same, but in two threads.

    The calling thread brings the state to the time of the next image and reads it.
    Meanwhile a second one interpolates the channels of the image before and computes
    angle and degree; it also takes part in the kernels of the first one, and the other
    way round.  It stays in compiled code: with a thread that runs Python, the two would
    wait for Python's lock for longer than they gain.

    Parameters
    ----------
    fusion : Fusion
        Of a source that need not be shown without delay.
    """

    def __init__(self, fusion: Fusion) -> None:
        self._fusion = fusion
        self._lock = threading.Lock()       # an iterator may be shared by threads
        self._waiting: deque[Callable[[], PolarFrame]] = deque()
        self._depth = 0
        self._error: Exception | None = None

    def __next__(self) -> PolarFrame:
        with self._lock:
            self._read_on()
            if self._waiting:
                return self._waiting.popleft()()
            if self._error is not None:
                error, self._error = self._error, None
                raise error
            self._fusion.close()
            raise StopIteration

    def _read_on(self) -> None:
        """Read images until enough wait, or until there is an error or the end."""
        self._depth = min(self._depth + 1, DEPTH)   # the first one is not delayed
        while len(self._waiting) < self._depth and self._error is None:
            try:
                if not self._fusion.advance():
                    return
                self._waiting.append(self._fusion.begin_image())
            except Exception as error:  # raised after the images that precede it
                self._error = error
