"""VideoCapture: fused images through the interface of cv2.VideoCapture."""
from __future__ import annotations

import enum
import io
import os
import re
import threading
from collections.abc import Sequence
from typing import Any, NoReturn, Self, Unpack, overload

import numpy as np

from pdavis_cv._advice import Advises
from pdavis_cv._opencv import native_capture, opencv_name
from pdavis_cv._options import names_options
from pdavis_cv._types import Image
from pdavis_cv.capture.constants import CAP_PDAVIS_BGR
from pdavis_cv.capture.manners import (
    StsBadArg,
    overloads,
    raise_like_cv2,
    unknown_property,
)
from pdavis_cv.capture.outputs import number_of
from pdavis_cv.capture.session import FAILURES, Session, View
from pdavis_cv.capture.source import checked_parameters, is_ours, parameters_of
from pdavis_cv.fusion.options import AllKeywords, FusionOptions
from pdavis_cv.reconstruct.base import Factory
from pdavis_cv.recording.base import Source
from pdavis_cv.recording.options import SourceOptions

_CAP_ANY, _PROP_BACKEND = 0, 42
_LONG_NUMBER = re.compile(r"%0*[1-9]\d{3,}[diu]")
_VIEW = ("output", "gain", "gamma", "log", "open_timeout_ms", "read_timeout_ms")

Openable = (str | os.PathLike[str] | int | Source
            | Sequence[str | os.PathLike[str]] | None)


class CaptureStatus(enum.StrEnum):
    """Why the last call of a VideoCapture succeeded or failed."""

    CLOSED = "closed"
    OK = "ok"
    EOF = "end of file"
    ERROR = "error"


class CaptureKeywords(AllKeywords, total=False):
    """The keyword arguments of `VideoCapture`, for type checkers and editors."""

    index: int | None
    output: int | str
    gain: float
    gamma: float
    log: bool


@names_options(FusionOptions, SourceOptions, rest="method_parameters")
class VideoCapture(Advises):
    """Read a recording as a sequence of images, like cv2.VideoCapture.

    Errors of the source are reported as cv2 does: opening and reading raise no
    exception, `read` returns ``(False, None)`` at the end, where ``isOpened()`` stays
    True; `last_error` holds the reason.  Unlike in cv2, seeking is exact: after any
    ``set`` of a position, images have the same bits as when reading from the beginning.
    A source that is not a recording is passed to a real ``cv2.VideoCapture``; with a
    `layout`, a video or an image is read as the mosaic of a polarization camera.

    Parameters
    ----------
    filename : path, address, Source or list of paths, optional
        The source to open; None opens nothing.  A live source (see `open_source`) has
        no positions, and its ``FRAME_COUNT`` is -1; `grab` waits for the next image, at
        most ``CAP_PROP_READ_TIMEOUT_MSEC``.
    apiPreference : int
        ``CAP_PDAVIS`` to open the source here, where a number is the number of a camera
        (`pdavis devices`); another ``cv2.CAP_*`` to open it with cv2.
    params : sequence of number
        Properties to set on opening: property, value, property, value ...
    index : int, optional
        Number of a camera, for cv2.
    output : int or str
        Output of ``read()``: ``CAP_PDAVIS_*``, or its name, such as ``"aop"``: of any
        quantity in ``QUANTITIES`` as numbers, or with ``_bgr`` as a picture.
    gain, gamma : float
        Parameters of the grey picture ``255 * (gain * S0 / 2 / white) ** (1 / gamma)``;
        white is the converter's full scale at the recording's first exposure.
    log : bool
        Make grey proportional to the logarithm, down to white / 1023.
    {options}
    **method_parameters
        Parameters of the method of `fuse`, e.g. ``cutoff_hz``.

    Raises
    ------
    TypeError, ValueError
        If a parameter of `fuse` is unknown, has the wrong type or is out of range.
    cv2.error
        If another argument has a type that cv2 rejects.

    Examples
    --------
    >>> from pdavis_cv import CAP_PDAVIS_DOLP, Layout
    >>> from pdavis_cv.data import example_recording
    >>> with VideoCapture(example_recording(), fps=100, layout=Layout.PDAVIS) as cap:
    ...     ok, picture = cap.read()
    ...     ok, dolp = cap.retrieve(None, CAP_PDAVIS_DOLP)
    >>> picture.shape, dolp.dtype
    ((260, 346, 3), dtype('float32'))
    """

    @overload
    def __init__(
        self,
        filename: Openable = ...,
        apiPreference: int = ...,
        params: Sequence[float] = ...,
        **keywords: Unpack[CaptureKeywords],
    ) -> None: ...

    @overload
    def __init__(
        self,
        filename: Openable = ...,
        apiPreference: int = ...,
        params: Sequence[float] = ...,
        *,
        method: Factory,
        **keywords: Any,
    ) -> None: ...

    def __init__(
        self,
        filename: Openable = None,
        apiPreference: int = _CAP_ANY,
        params: Sequence[float] = (),
        *,
        index: int | None = None,
        output: int | str = CAP_PDAVIS_BGR,
        gain: float = 1.0,
        gamma: float = 1.0,
        log: bool = False,
        **fuse_parameters: Any,
    ) -> None:
        checked_parameters(fuse_parameters)
        self._lock = threading.RLock()
        self._exceptions = False
        self._session: Session | None = None
        self._foreign: Any = None
        self._source: Any = None
        self._parameters = fuse_parameters
        self._view = View(number_of(output), True, gain, gamma, log)
        self._status = CaptureStatus.CLOSED
        self._error: str | None = None
        if filename is not None or index is not None:
            self._open("VideoCapture", filename, apiPreference, params, index)

    # ---- opening -------------------------------------------------------------

    @overloads
    def open(
        self,
        filename: Openable = None,
        apiPreference: int = _CAP_ANY,
        params: Sequence[float] = (),
        *,
        index: int | None = None,
    ) -> bool:
        """Open another source with the parameters of the constructor.

        Returns
        -------
        bool
            False if it cannot be opened; `last_error` then holds the reason.
        """
        if filename is None and index is None:
            raise_like_cv2("open", "Overload resolution failed: open() is missing "
                           "required argument 'filename' (pos 1)", StsBadArg)
        return self._open("open", filename, apiPreference, params, index)

    def _open(
        self, function: str, filename: Any, backend: Any, params: Any, index: Any
    ) -> bool:
        with self._lock:
            self.release()
            source = filename if index is None else index
            if filename is not None and index is not None:
                self._refuse(function, "filename and index exclude each other")
            several = isinstance(source, (list, tuple)) and len(source) > 0
            if not (several or _is_integer(source) or isinstance(
                    source, (str, bytes, os.PathLike, Source, io.BufferedIOBase))):
                self._refuse(function, f"can't open by {type(source).__name__}")
            if not _is_integer(backend):
                self._refuse(function, "apiPreference must be an integer")
            backend = int(backend)
            ours = is_ours(source, backend, self._parameters)
            try:
                values = [float(value) for value in params]
            except (TypeError, ValueError):
                self._refuse(function, "params must be a sequence of integers")
            if not ours and several:
                self._refuse(function, "several files are opened by no backend of cv2")
            if not ours:
                return self._open_foreign(function, source, backend, values)
            return self._open_here(function, source, values)

    def _open_here(self, function: str, source: Any, values: list[float]) -> bool:
        given = parameters_of(values)
        if given is None:
            return self._fail(function, f"params hold an unknown pair: {values}")
        view = View(**{
            "convert": True, **{name: getattr(self._view, name) for name in _VIEW},
            **{name: given.pop(name) for name in _VIEW if name in given}})
        parameters = {**self._parameters, **given}
        try:
            self._session = Session(source, parameters, view)
        except (OSError, ImportError) as error:
            return self._fail(function, str(error))
        self._source = source
        self._status, self._error = CaptureStatus.OK, None
        return True

    def _open_foreign(
        self, function: str, source: Any, backend: int, values: list[float]
    ) -> bool:
        if self._parameters:
            return self._fail(
                function, f"{source!r} is not a recording, so that "
                f"{', '.join(self._parameters)} cannot be used; a mosaic video or "
                "image needs layout=, e.g. layout=\"sony\"")
        if self._view.output != CAP_PDAVIS_BGR:
            return self._fail(
                function, f"{source!r} is not a recording: if it is of a polarization "
                'camera, its layout is needed, e.g. layout="sony"')
        if isinstance(source, bytes):
            return self._fail(function, "a path must be str, got bytes")
        if isinstance(source, str) and _LONG_NUMBER.search(source):
            # FFmpeg writes out the digits of each.
            return self._fail(function, f"{source!r}: no file has so long a number")
        try:
            foreign = native_capture()()
            name = opencv_name(source) if isinstance(
                source, str | os.PathLike) else source      # OpenCV 4.6 takes no Path
        except (ImportError, OSError) as error:
            return self._fail(function, str(error))
        arguments = (backend, [int(v) for v in values]) if values else (backend,)
        opened = foreign.open(name, *arguments)
        if not opened:
            return self._fail(function, f"cv2.VideoCapture cannot open {source!r}")
        foreign.setExceptionMode(self._exceptions)
        self._foreign, self._source = foreign, source
        self._status, self._error = CaptureStatus.OK, None
        return True

    def isOpened(self) -> bool:
        """Return whether a source is open, which it is at its end too."""
        with self._lock:
            if self._foreign is not None:
                return bool(self._foreign.isOpened())
            return self._session is not None

    def release(self) -> None:
        """Close the source; `open` may be called again."""
        with self._lock:
            session, self._session = self._session, None
            foreign, self._foreign = self._foreign, None
            self._status = CaptureStatus.CLOSED
            if session is not None:
                session.close()
            if foreign is not None:
                foreign.release()

    # ---- reading ---------------------------------------------------------------

    def grab(self) -> bool:
        """Move to the next image; return False at the end."""
        with self._lock:
            if self._foreign is not None:
                return self._noted(self._foreign.grab())
            return self._grab() or self._failed("grab")

    @overloads
    def retrieve(
        self, image: Any = None, flag: int | str = CAP_PDAVIS_BGR
    ) -> tuple[bool, Image | None]:
        """Return an output of the image that was grabbed last.

        Parameters
        ----------
        image : ndarray, optional
            Filled and returned if its shape and dtype fit; otherwise a new array is
            returned.  An integer is ignored.
        flag : int or str
            ``CAP_PDAVIS_*``, or its name, such as ``"aop"``.

        Returns
        -------
        ok : bool
            False if no image was grabbed or the output is unknown.
        image : ndarray or None
        """
        with self._lock:
            if self._foreign is not None:
                ok, made = self._foreign.retrieve(image, flag)
                return self._noted(ok), made
            self._check_image("retrieve", image)
            try:
                flag = number_of(flag)
            except ValueError as error:
                self._refuse("retrieve", str(error))
            if not _is_integer(flag):
                self._refuse("retrieve", "Argument 'flag' is required to be an integer")
            return self._retrieve("retrieve", image, int(flag))

    @overloads
    def read(self, image: Any = None) -> tuple[bool, Image | None]:
        """Grab the next image and return its output ``CAP_PROP_PDAVIS_OUTPUT``.

        Parameters
        ----------
        image : ndarray, optional
            See `retrieve`.
        """
        with self._lock:
            if self._foreign is not None:
                ok, made = self._foreign.read(image)
                return self._noted(ok), made
            self._check_image("read", image)
            if not self._grab():
                return self._failed("grab"), None
            assert self._session is not None
            return self._retrieve("read", image, self._session.view.output)

    def _grab(self) -> bool:
        if self._session is None:
            self._not_open()
            return False
        try:
            if self._session.grab():
                self._status, self._error = CaptureStatus.OK, None
                return True
        except FAILURES as error:
            self._status, self._error = CaptureStatus.ERROR, str(error)
            return False
        self._status, self._error = CaptureStatus.EOF, "the recording ended"
        return False

    def _retrieve(
        self, function: str, image: Any, flag: int
    ) -> tuple[bool, Image | None]:
        if self._session is None:
            self._not_open()
            return self._failed(function), None
        try:
            made = self._session.retrieve(flag)
        except LookupError as error:
            self._error = str(error)
            return self._failed(function), None
        except FAILURES as error:
            self._status, self._error = CaptureStatus.ERROR, str(error)
            return self._failed(function), None
        if isinstance(image, np.ndarray):
            if image.shape != made.shape or image.dtype != made.dtype:
                return True, made
            image[...] = made
            return True, image
        return True, made

    def __iter__(self) -> Self:
        """Iterate over the images that `read` returns, to the end."""
        return self

    def __next__(self) -> Image:
        with self._lock:
            if self._foreign is not None or self._grab():
                ok, image = (self._foreign.read() if self._foreign is not None
                             else self.retrieve(None, self._session.view.output)
                             if self._session is not None else (False, None))
                if ok and image is not None:
                    return image
            raise StopIteration

    # ---- properties --------------------------------------------------------------

    def get(self, propId: int) -> float:
        """Return the value of a property; for an unknown one, that of cv2."""
        with self._lock:
            if not _is_integer(propId):
                raise TypeError("Argument 'propId' is required to be an integer")
            if self._foreign is not None:
                return float(self._foreign.get(propId))
            if self._session is None:
                return -1.0 if propId == _PROP_BACKEND else unknown_property()
            try:
                value = self._session.get(int(propId))
            except FAILURES as error:
                self._status, self._error = CaptureStatus.ERROR, str(error)
                value = None
            return unknown_property() if value is None else value

    def set(self, propId: int, value: float) -> bool:
        """Change a property or the position; return False if it cannot be changed.

        Setting a position seeks exactly: the state is the same as after reading all
        images up to there.  A change of the rate keeps the time.
        """
        with self._lock:
            if not _is_integer(propId):
                raise TypeError("Argument 'propId' is required to be an integer")
            if isinstance(value, bool):
                raise TypeError("Argument 'value' must be double, not bool")
            try:
                number = 0.0 if value is None else float(value)
            except (TypeError, ValueError):
                raise TypeError(
                    "Argument 'value' can not be treated as a double") from None
            if self._foreign is not None:
                return bool(self._foreign.set(propId, number))
            if propId == _PROP_BACKEND and self._session is not None:
                raise_like_cv2("set", "can't set read-only property")
            return self._set(int(propId), number) or self._failed("set")

    def _set(self, prop: int, value: float) -> bool:
        if self._session is None:
            self._not_open()
            return False
        try:
            if self._session.set(prop, value):
                self._status, self._error = CaptureStatus.OK, None
                return True
            self._error = f"property {prop} cannot be set"
        except (TypeError, ValueError) as error:
            self._error = str(error)
        except FAILURES as error:
            self._status, self._error = CaptureStatus.ERROR, str(error)
        return False

    def getBackendName(self) -> str:
        """Return ``"PDAVIS"``, or the name of cv2's backend."""
        with self._lock:
            if self._foreign is not None:
                return str(self._foreign.getBackendName())
            if self._session is None:
                raise_like_cv2("getBackendName", "api != 0", -215)
            return "PDAVIS"

    @property
    def status(self) -> CaptureStatus:
        """Why the last call succeeded or failed, e.g. at the end."""
        return self._status

    @property
    def last_error(self) -> str | None:
        """Description of the last call's failure, None if it succeeded."""
        return self._error

    # ---- exceptions --------------------------------------------------------------

    def setExceptionMode(self, enable: bool) -> None:
        """Set whether failures raise cv2.error."""
        with self._lock:
            try:
                self._exceptions = bool(enable + 0)
            except (TypeError, ValueError):
                raise TypeError(
                    "Argument 'enable' is not convertable to bool") from None
            if self._foreign is not None:
                self._foreign.setExceptionMode(self._exceptions)

    def getExceptionMode(self) -> bool:
        """Return whether failures raise cv2.error."""
        return self._exceptions

    def _fail(self, function: str, message: str) -> bool:
        """Record why opening failed."""
        self._status, self._error = CaptureStatus.ERROR, message
        return self._failed(function)

    def _not_open(self) -> None:
        if self._status is not CaptureStatus.ERROR:  # that opening failed, and why
            self._error = "the capture is not open"

    def _failed(self, function: str) -> bool:
        if self._exceptions:
            raise_like_cv2(function, self._error or "")
        return False

    def _noted(self, ok: bool) -> bool:
        self._status = CaptureStatus.OK if ok else CaptureStatus.EOF
        self._error = None if ok else "cv2.VideoCapture gave no image"
        return bool(ok)

    def _refuse(self, function: str, message: str) -> NoReturn:
        raise_like_cv2(function, f"Overload resolution failed: {message}", StsBadArg)

    def _check_image(self, function: str, image: Any) -> None:
        if image is None or _is_integer(image):
            return
        if not isinstance(image, np.ndarray):
            self._refuse(function, "Argument 'image' must be an array, got "
                         f"{type(image).__name__}")
        if not image.flags.c_contiguous or not image.flags.writeable:
            self._refuse(function, "Layout of the output array image is incompatible "
                         "with cv::Mat")

    @staticmethod
    def waitAny(
        streams: Sequence[Any], timeoutNs: int = 0
    ) -> tuple[bool, Sequence[int]]:
        """Raise the error of cv2, which can wait only for V4L cameras."""
        if not (streams is None or hasattr(streams, "__len__")):
            raise TypeError("Can't parse 'streams'. Input argument doesn't provide "
                            "sequence protocol")
        if streams is None or not len(streams):
            raise_like_cv2("waitAny", "!streams.empty()", -215)
        raise_like_cv2(
            "waitAny", "VideoCapture::waitAny() is supported by V4L backend only", -213)

    # ---- context, copies ---------------------------------------------------------

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.release()

    def __del__(self) -> None:
        if hasattr(self, "_session"):
            self.release()

    def __getstate__(self) -> dict[str, Any]:
        with self._lock:
            if self._foreign is not None:
                raise TypeError("cannot pickle a capture that cv2 opened")
            state = {name: getattr(self, name) for name in (
                "_exceptions", "_source", "_parameters", "_view", "_status", "_error")}
            if self._session is not None:
                state["_parameters"] = self._session.parameters
                state["_view"] = self._session.view
                state["position"] = self._session.state()
            return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        position = state.pop("position", None)
        self._lock = threading.RLock()
        self._session, self._foreign = None, None
        self.__dict__.update(state)
        if position is not None:
            try:
                self._session = Session(self._source, self._parameters, self._view)
                self._session.restore(position)
            except (OSError, ImportError) as error:
                self._status, self._error = CaptureStatus.ERROR, str(error)

    def __repr__(self) -> str:
        where = "closed" if not self.isOpened() else (
            f"{self._source!r}, next image {self.get(1):g}")
        return f"<pdavis_cv.VideoCapture {where}>"


def _is_integer(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)
