"""What cv2.VideoCapture does, as data: a row is a claim, a probe and its outcome.

Measured with OpenCV 4.6 to 5.0 on a 30-image MJPG file of 25 images per second: each
row is true of all versions from `since` on.  A probe is given ``K``: ``K.cap()`` makes
an open capture, ``K.ctor(...)`` calls the class, ``K.path`` is the file, ``K.missing``
names none.
"""
import math
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

VERSION = tuple(map(int, cv2.__version__.split(".")[:2]))
needs_animations = pytest.mark.skipif(VERSION < (4, 12), reason="OpenCV before 4.12")
UNKNOWN = 0.0 if VERSION < (5,) else -1.0
POS_MSEC, POS_FRAMES, WIDTH, HEIGHT, FPS, COUNT, FORMAT = 0, 1, 3, 4, 5, 7, 8
CONVERT_RGB, BACKEND = 16, 42
REFUSED, TYPE_ERROR = "cv2.error", "TypeError"


@dataclass(frozen=True)
class Row:
    claim: str
    probe: object
    expected: object
    ours: object = None       # what ours gives instead, and
    reason: str = ""          # why it differs
    since: tuple = (4, 6)     # the version of OpenCV


def outcome(probe, kit):
    """Return what a probe gave, errors by the name of their kind."""
    try:
        return probe(kit)
    except cv2.error:
        return REFUSED
    except TypeError:
        return TYPE_ERROR


def kind(image):
    return None if image is None else (image.shape[2:], str(image.dtype),
                                       image.flags.c_contiguous)


def read_all(cap):
    n = 0
    while cap.read()[0]:
        n += 1
    return n


def _at_end(kit):
    cap = kit.cap()
    return cap, read_all(cap)


def _after(kit, *calls):
    """Return a capture after calls like ("read",) or ("set", 1, 10)."""
    cap = kit.cap()
    for name, *arguments in calls:
        getattr(cap, name)(*arguments)
    return cap


def _closed(kit):
    cap = kit.cap()
    cap.release()
    return cap


def _strict(kit, closed=False):
    cap = _closed(kit) if closed else kit.cap()
    cap.setExceptionMode(True)
    return cap


def _positions(kit, n):
    cap = kit.cap()
    found = []
    for _ in range(n):
        cap.grab()
        found.append((cap.get(POS_FRAMES), cap.get(POS_MSEC)))
    return found


def _next_after(kit, prop, value):
    """Return what set() gave and the number of the image that is read next."""
    cap = _after(kit, ("grab",))
    done = cap.set(prop, value)
    place = cap.get(POS_FRAMES)
    ok, image = cap.read()
    return done, place, ok and kit.number(image)


def _filled(kit, buffer):
    ok, image = kit.cap().read(buffer)
    return ok, image is buffer


def _twice(kit):
    cap = _after(kit, ("grab",))
    (a, one), (b, two) = cap.retrieve(), cap.retrieve()
    return a, b, np.array_equal(one, two), np.shares_memory(one, two)


def _reopened(kit):
    cap = _closed(kit)
    return cap.open(kit.path), cap.read()[0]


def _open_fails_on_open(kit):
    cap = kit.cap()
    return cap.open(kit.missing), cap.isOpened()


def _with(kit):
    with kit.cap() as cap:
        inside = cap.isOpened()
    return inside, cap.isOpened()


def _threads_progress(kit):
    import threading
    cap, found = kit.cap(), []
    thread = threading.Thread(target=lambda: found.append(cap.read()[0]))
    thread.start()
    thread.join(20)
    return found


OURS_ITERATES = "beyond cv2: iteration is offered"
OURS_PICKLES = "beyond cv2: captures pickle"

ROWS = [
    # opening
    Row("without arguments nothing is open", lambda K: K.ctor().isOpened(), False),
    Row("a missing file does not raise", lambda K: K.ctor(K.missing).isOpened(), False),
    Row("open() of a missing file is False",
        lambda K: K.ctor().open(K.missing), False),
    Row("a folder does not raise",
        lambda K: K.ctor(str(Path(K.path).parent)).isOpened(), False),
    Row("an unknown backend does not open",
        lambda K: K.ctor(K.path, 12345).isOpened(), False),
    Row("an unknown property in params does not open",
        lambda K: K.ctor(K.path, 0, [93999, 1]).isOpened(), False, since=(4, 14)),
    Row("no params are fine", lambda K: K.ctor(K.path, 0, []).isOpened(), True),
    Row("a pathlib.Path opens", lambda K: K.ctor(Path(K.path)).isOpened(), True,
        since=(4, 10)),
    Row("filename may be named", lambda K: K.ctor(filename=K.path).isOpened(), True),
    Row("None does not open", lambda K: K.ctor(None).isOpened(), False),
    Row("bytes do not open", lambda K: K.ctor(b"x").isOpened(), False, since=(4, 12)),
    Row("a float is refused", lambda K: K.ctor(1.5), REFUSED),
    Row("a list is refused", lambda K: K.ctor([]), REFUSED),
    Row("a bool is refused", lambda K: K.ctor(True), REFUSED),
    Row("an unknown keyword is refused", lambda K: K.ctor(K.path, foo=1), REFUSED,
        TYPE_ERROR, "parameters of fuse are Python's, and so is the error"),
    Row("open() without arguments is refused", lambda K: K.cap().open(), REFUSED),
    Row("open() with an unknown keyword is refused",
        lambda K: K.cap().open(K.path, foo=1), REFUSED),
    Row("a failed open() closes what was open", _open_fails_on_open, (False, False)),
    Row("release() may be followed by open()", _reopened, (True, True)),
    Row("release() gives None, twice too",
        lambda K: (lambda c: (c.release(), c.release()))(K.cap()), (None, None)),
    Row("with closes", _with, (True, False), since=(4, 14)),
    # reading
    Row("read() gives contiguous BGR bytes",
        lambda K: kind(K.cap().read()[1]), ((3,), "uint8", True)),
    Row("all images are read", lambda K: _at_end(K)[1], 30),
    Row("at the end read() gives (False, None)",
        lambda K: _at_end(K)[0].read(), (False, None)),
    Row("at the end grab() is False", lambda K: _at_end(K)[0].grab(), False),
    Row("at the end retrieve() gives (False, None)",
        lambda K: _at_end(K)[0].retrieve(), (False, None)),
    Row("at the end it is still open", lambda K: _at_end(K)[0].isOpened(), True),
    Row("from the end it rewinds",
        lambda K: (lambda c: (c.set(POS_FRAMES, 0), read_all(c)))(_at_end(K)[0]),
        (True, 30)),
    Row("retrieve() before any grab gives (False, None)",
        lambda K: K.cap().retrieve(), (False, None)),
    Row("retrieve() twice gives equal separate images", _twice,
        (True, True, True, False)),
    Row("a buffer that fits is filled",
        lambda K: _filled(K, np.zeros(K.shape, np.uint8)), (True, True)),
    Row("a buffer of another shape is not",
        lambda K: _filled(K, np.zeros((2, 2, 3), np.uint8)), (True, False)),
    Row("a buffer of another dtype is not",
        lambda K: _filled(K, np.zeros(K.shape, np.float32)), (True, False)),
    Row("a strided buffer is refused",
        lambda K: _filled(K, np.zeros((2, 8, 3), np.uint8)[:, ::2]), REFUSED),
    Row("a read-only buffer is refused",
        lambda K: _filled(K, np.broadcast_to(np.uint8(0), K.shape)), REFUSED),
    Row("read(None) is read()", lambda K: K.cap().read(None)[0], True),
    Row("an int as image is ignored", lambda K: K.cap().read(0)[0], True),
    Row("retrieve(None, 0)",
        lambda K: _after(K, ("grab",)).retrieve(None, 0)[0], True),
    Row("retrieve(0, 0)", lambda K: _after(K, ("grab",)).retrieve(0, 0)[0], True),
    Row("retrieve(5) ignores the 5",
        lambda K: kind(_after(K, ("grab",)).retrieve(5)[1]), ((3,), "uint8", True)),
    Row("an unknown flag", lambda K: _after(K, ("grab",)).retrieve(None, 99)[0], True,
        False, "FFmpeg ignores most flags; ours name outputs, so that an unknown one "
        "is (False, None)"),
    Row("a text as image is refused", lambda K: K.cap().read("a"), REFUSED),
    Row("a list as image is refused", lambda K: K.cap().read([]), REFUSED),
    Row("read() with an unknown keyword is refused",
        lambda K: K.cap().read(foo=1), REFUSED),
    Row("retrieve() with an unknown keyword is refused",
        lambda K: K.cap().retrieve(foo=1), REFUSED),
    Row("a text as flag is refused", lambda K: K.cap().retrieve(None, "a"), REFUSED),
    # position
    Row("POS_FRAMES is 0 before reading", lambda K: K.cap().get(POS_FRAMES), 0.0),
    Row("POS_MSEC is 0 before reading", lambda K: K.cap().get(POS_MSEC), 0.0),
    Row("positions: the next image, the last one's time",
        lambda K: _positions(K, 3), [(1.0, 0.0), (2.0, 40.0), (3.0, 80.0)]),
    Row("POS_FRAMES at the end is FRAME_COUNT",
        lambda K: _at_end(K)[0].get(POS_FRAMES), 30.0),
    Row("POS_MSEC at the end", lambda K: _at_end(K)[0].get(POS_MSEC), 0.0, 1160.0,
        "FFmpeg falls back to 0; ours stays at the last image's time"),
    Row("a negative position is clamped",
        lambda K: _next_after(K, POS_FRAMES, -5), (True, 0.0, 0)),
    Row("a position beyond the end is clamped",
        lambda K: _next_after(K, POS_FRAMES, 1000), (True, 30.0, False)),
    Row("a position is truncated",
        lambda K: _next_after(K, POS_FRAMES, 10.6), (True, 10.0, 10)),
    Row("the position of the last image",
        lambda K: _next_after(K, POS_FRAMES, 29), (True, 29.0, 29)),
    *(Row(f"a time of {ms} ms is image {k}",
          lambda K, ms=ms, k=k: _next_after(K, POS_MSEC, ms), (True, float(k), k),
          since=(4, 13) if math.isnan(ms) else (4, 6))
      for ms, k in [(400, 10), (419, 10), (420, 11), (440, 11), (0, 0), (-50, 0),
                    (1160, 29), (float("nan"), 0)]),
    Row("a time beyond the end is clamped",
        lambda K: _next_after(K, POS_MSEC, 1e9), (True, 30.0, False)),
    Row("after a seek POS_MSEC is that of the image before",
        lambda K: _after(K, ("set", POS_FRAMES, 10)).get(POS_MSEC), 360.0,
        since=(4, 13)),
    Row("after a seek retrieve() gives the image before",
        lambda K: K.number(_after(K, ("set", POS_FRAMES, 10)).retrieve()[1]), 9),
    # properties
    Row("FPS", lambda K: K.cap().get(FPS), 25.0),
    Row("FRAME_COUNT", lambda K: K.cap().get(COUNT), 30.0),
    Row("WIDTH and HEIGHT are the image's",
        lambda K: (K.cap().get(HEIGHT), K.cap().get(WIDTH)) == K.shape[:2], True),
    Row("FORMAT is CV_8UC3 of this version",
        lambda K: K.cap().get(FORMAT) == cv2.CV_8UC3, True, since=(4, 14)),
    Row("CONVERT_RGB is on", lambda K: K.cap().get(CONVERT_RGB), 1.0, since=(4, 7)),
    Row("without CONVERT_RGB there is one channel",
        lambda K: _after(K, ("set", CONVERT_RGB, 0)).read()[1].ndim, 2, since=(4, 7)),
    Row("BACKEND has a number", lambda K: K.cap().get(BACKEND) > 0, True),
    Row("an unknown property", lambda K: K.cap().get(99999), UNKNOWN),
    Row("a negative property", lambda K: K.cap().get(-5), UNKNOWN),
    Row("a property that is not supported", lambda K: K.cap().get(15), UNKNOWN),
    Row("an unknown property cannot be set", lambda K: K.cap().set(99999, 1), False),
    *(Row(f"{name} cannot be set",
          lambda K, prop=prop: (lambda c: (c.set(prop, 7), c.get(prop) == 7))(K.cap()),
          (False, False))
      for name, prop in [("FPS", FPS), ("WIDTH", WIDTH), ("FRAME_COUNT", COUNT),
                         ("FORMAT", FORMAT), ("EXPOSURE", 15)]),
    Row("BACKEND refuses to be set", lambda K: K.cap().set(BACKEND, 1), REFUSED),
    Row("get() may name its argument", lambda K: K.cap().get(propId=COUNT), 30.0),
    Row("get(1.5)", lambda K: K.cap().get(1.5), TYPE_ERROR),
    Row("get(True)", lambda K: K.cap().get(True), TYPE_ERROR),
    Row("get('a')", lambda K: K.cap().get("a"), TYPE_ERROR),
    Row("get()", lambda K: K.cap().get(), TYPE_ERROR),
    Row("set(1.0, 1)", lambda K: K.cap().set(1.0, 1), TYPE_ERROR),
    Row("set(1, 'a')", lambda K: K.cap().set(1, "a"), TYPE_ERROR),
    Row("set(1, True)", lambda K: K.cap().set(1, True), TYPE_ERROR),
    Row("set(1, None) counts as 0", lambda K: K.cap().set(1, None), True),
    # closed
    Row("closed: read()", lambda K: _closed(K).read(), (False, None)),
    Row("closed: grab()", lambda K: _closed(K).grab(), False),
    Row("closed: retrieve()", lambda K: _closed(K).retrieve(), (False, None)),
    Row("closed: get()", lambda K: _closed(K).get(COUNT), UNKNOWN),
    Row("closed: get(BACKEND)", lambda K: _closed(K).get(BACKEND), -1.0),
    Row("closed: set()", lambda K: _closed(K).set(POS_FRAMES, 0), False),
    Row("closed: getBackendName()", lambda K: _closed(K).getBackendName(), REFUSED),
    Row("closed: isOpened()", lambda K: _closed(K).isOpened(), False),
    # exception mode
    Row("exception mode is off at first", lambda K: K.cap().getExceptionMode(), False),
    Row("exception mode is remembered",
        lambda K: _strict(K).getExceptionMode(), True),
    Row("exception mode: get() never raises",
        lambda K: _strict(K).get(99999), UNKNOWN),
    Row("exception mode: set()", lambda K: _strict(K).set(99999, 1), REFUSED),
    Row("exception mode: open()", lambda K: _strict(K).open(K.missing), REFUSED),
    Row("exception mode: retrieve() before grab()",
        lambda K: _strict(K).retrieve(), REFUSED),
    Row("exception mode: grab() closed",
        lambda K: _strict(K, closed=True).grab(), REFUSED),
    Row("exception mode: read() closed",
        lambda K: _strict(K, closed=True).read(), REFUSED),
    Row("exception mode: read() at the end",
        lambda K: read_all(_strict(K)), REFUSED),
    Row("exception mode: open() that works",
        lambda K: _strict(K).open(K.path), True),
    Row("exception mode needs a truth value",
        lambda K: K.cap().setExceptionMode("a"), TYPE_ERROR),
    # the rest
    Row("another thread can read", _threads_progress, [True]),
    Row("waitAny() is for V4L only", lambda K: K.ctor.waitAny([K.cap()]), REFUSED,
        since=(4, 7)),
    Row("waitAny() of nothing", lambda K: K.ctor.waitAny([]), REFUSED, since=(4, 7)),
    Row("there is no len()", lambda K: len(K.cap()), TYPE_ERROR),
    Row("iteration", lambda K: sum(1 for _ in K.cap()), TYPE_ERROR, 30, OURS_ITERATES),
    Row("pickling",
        lambda K: __import__("pickle").loads(__import__("pickle").dumps(K.cap()))
        .get(COUNT), TYPE_ERROR, 30.0, OURS_PICKLES),
]


def kit(ctor, path, missing, shape, number, **keywords):
    """Return what the probes need for one of the two classes."""
    def cap():
        made = ctor(str(path))      # not all take a Path
        assert made.isOpened()
        return made

    return SimpleNamespace(ctor=ctor, cap=cap, path=str(path), missing=str(missing),
                           shape=shape, number=number)
