"""fuse(): iterate over the images of a recording, in one thread or in several."""
from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Iterator
from typing import Any, Unpack, overload

from pdavis_cv._advice import Advises
from pdavis_cv._options import changed, names_options
from pdavis_cv._workers import Begun
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.fusion.engine import Fusion
from pdavis_cv.fusion.options import FusionKeywords, FusionOptions
from pdavis_cv.fusion.turning import TurningFusion
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.reconstruct.base import Factory
from pdavis_cv.recording.base import Recording, Source

DEPTH = 3
"""Images that are read before the first of them is returned: one to work on while the
next is read, and one in reserve, so that no thread sleeps until the other is ready.
Without the reserve two threads gain 1.5 in place of 1.65 (`kalman`)."""

LEAST_PIXELS = 1 << 16
"""Smallest image that another thread is given: with smaller ones it gains little."""


@overload
def fuse(
    recording: Source, options: FusionOptions | None = ...,
    **changes: Unpack[FusionKeywords],
) -> Fusion | ReadAhead | TurningFusion: ...


@overload
def fuse(
    recording: Source, options: FusionOptions | None = ..., *, method: Factory,
    **changes: Any,
) -> Fusion | ReadAhead | TurningFusion: ...


@names_options(FusionOptions, rest="method_parameters")
def fuse(
    recording: Source, options: FusionOptions | None = None, **changes: Any
) -> Fusion | ReadAhead | TurningFusion:
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
        With `threads` above 1, it reads a recording ahead.  Its `close` ends the
        threads.  Its `camera` is a `Calibration` of what is known of the camera; given
        as `calibration`, learning from another recording starts there.

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
    given = changed(FusionOptions, options, changes)
    if given.analyser is not None and isinstance(recording, Source):
        return TurningFusion(recording, given)
    fusion = Fusion(recording, given)
    # Without events an image is a frame that is held: there is nothing to share.
    ahead = (fusion.options.threads > 1 and isinstance(recording, Recording)
             and fusion.needs.events
             and math.prod(fusion.window.shape) >= LEAST_PIXELS)
    return ReadAhead(fusion) if ahead else fusion


class ReadAhead(Advises, Iterator[PolarFrame]):
    """Iterate over a Fusion's images, which are the same, read ahead.

    The calling thread brings the state to the time of the next image and reads it.
    Meanwhile another one makes the images before, angle and degree included.  The
    fusion has at least two threads, and a source that need not be shown without delay.
    """

    def __init__(self, fusion: Fusion) -> None:
        self._fusion = fusion
        self._lock = threading.Lock()       # an iterator may be shared by threads
        self._ahead: deque[Begun[PolarFrame] | PolarFrame] = deque()
        self._depth = 0
        self._error: Exception | None = None

    def __len__(self) -> int:
        """Return the number of all images; see `Fusion`."""
        with self._lock:        # it may have to read the beginning
            return len(self._fusion)

    @property
    def camera(self) -> Calibration:
        """What is known of the camera; see `Fusion`."""
        with self._lock:
            return self._fusion.camera

    def __next__(self) -> PolarFrame:
        with self._lock:
            self._read_on()
            if self._ahead:
                image = self._ahead.popleft()
                return image if isinstance(image, PolarFrame) else image.result()
            if self._error is not None:
                error, self._error = self._error, None
                raise error
        self.close()
        raise StopIteration

    def _read_on(self) -> None:
        """Read images until enough wait, or until there is an error or the end."""
        self._depth = min(self._depth + 1, DEPTH)   # the first one is not delayed
        while len(self._ahead) < self._depth and self._error is None:
            try:
                if not self._fusion.advance():
                    return
                self._ahead.append(self._fusion.begin_image())
            except Exception as error:  # raised after the images that precede it
                self._error = error

    def close(self) -> None:
        """End the threads; there is no further image."""
        with self._lock:
            self._fusion.close()
            self._ahead.clear()
