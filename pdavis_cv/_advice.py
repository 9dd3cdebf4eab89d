"""Errors of what an object does not have, which say what it is called here.

Other libraries have other names.  A class of `ADVICE` has `Advises` as its base, which
answers a name, an index, a loop or a length that it lacks from there, or else with the
name that is nearest.
"""
from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NoReturn

from pdavis_cv.registry import instead

_ITERATOR: Mapping[str, str] = {
    "[] read get_frame": "it is an iterator: loop over it, or call next()",
    "len": "without a rate, or an end in the file's header, count the images",
    "images frames": "the images are what a loop over it gives",
    "width height size": "its images' shape is (height, width), shape",
}

ADVICE: Mapping[str, Mapping[str, str]] = {
    "PolarFrame": {
        "[] len": "its planes are attributes, such as image.dolp and image.quad[0]",
        "width height size": "shape is (height, width)",
        "t time timestamp timestamps ts": "it is t_us",
        "aop_deg angle_deg": "it is numpy.degrees(image.aop)",
        "plot show imshow save": "render.summary(image) is a picture of it, and "
                                 "export.write_png writes one",
        "numpy to_numpy array data values channels": "its four channels are quad",
        "mask": "it is valid",
        "copy": "an image never changes; copy a plane, such as image.dolp.copy()",
        "events": "recording.events(start_us, stop_us) are those of an interval",
    },
    "Fusion": _ITERATOR,
    "ReadAhead": _ITERATOR,
    "Source": {
        "[] len": "it is read by its packets: for packet in recording.packets()",
        "width height size shape resolution": "info.sensor_size is (height, width)",
        "fps framerate frame_rate rate": "fps is an option of fuse(); the frames' own "
                                         "rate, if a file states it, is "
                                         "info.frame_times",
        "frames images read": "frames are in the packets: for packet in "
                              "recording.packets(), packet.frames",
        "duration length times": "info.start_us and info.stop_us are its ends",
        "format writer camera serial sensor sensor_size layout start_us stop_us "
        "exposure_us event_count frame_count biases": "it is info.{}",
        "t x y p": "recording.events() is an array with the fields t, x, y, p",
    },
    "RecordingInfo": {
        "width height size shape resolution": "sensor_size is (height, width)",
        "fps framerate frame_rate": "fps is an option of fuse(); the frames' own rate, "
                                    "if the file states it, is frame_times",
        "duration length": "it is stop_us - start_us",
        "frames": "it is frame_count", "events": "it is event_count",
    },
    "Packet": {
        "frame image": "frames is a tuple of at most one",
        "t x y p": "events is an array with the fields t, x, y, p",
        "time timestamp": "it begins at start_us",
    },
    "ApsFrame": {
        "image data frame values pixels": "it is dn, (height, width)",
        "width height size": "shape is (height, width)",
        "t t_us time timestamp": "the middle of its exposure is mid_us",
        "exposure": "it is exposure_ms",
        "[] len": "its values are dn",
    },
    "VideoCapture": {
        "fps framerate": "as in cv2, it is get(cv2.CAP_PROP_FPS)",
        "width": "as in cv2, it is get(cv2.CAP_PROP_FRAME_WIDTH)",
        "height": "as in cv2, it is get(cv2.CAP_PROP_FRAME_HEIGHT)",
        "shape size": "as in cv2, get(cv2.CAP_PROP_FRAME_WIDTH) and _HEIGHT are it",
        "len frame_count": "as in cv2, it is get(cv2.CAP_PROP_FRAME_COUNT)",
        "[] seek": "as in cv2, set(cv2.CAP_PROP_POS_FRAMES, number) and then read()",
        "close": "as in cv2, it is release()",
    },
}
"""What to say of names that a class lacks, several to a text; ``[]`` stands for an
index and a loop, ``len`` for a length, and ``{}`` in a text for the name."""


class Advises:
    """Base of classes that say what is meant by a name that they lack."""

    __slots__ = ()

    @classmethod
    def _advice(cls, name: str) -> str:
        """Return what to do instead of asking for a name, or nothing."""
        for one in cls.__mro__:
            for names, text in ADVICE.get(one.__name__, {}).items():
                if name.lower() in names.split():
                    return f"; {text.format(name)}"
        return instead(name, [one for one in dir(cls) if one[0] != "_"])

    if not TYPE_CHECKING:   # these would hide every mistake from mypy
        def __getattr__(self, name: str) -> NoReturn:
            kind = type(self)
            raise AttributeError(
                f"{kind.__name__} has no {name!r}"
                f"{'' if name[0] == '_' else kind._advice(name)}", name=name, obj=self)

        def __getitem__(self, key: Any) -> NoReturn:
            kind = type(self)
            raise TypeError(f"{kind.__name__} takes no index{kind._advice('[]')}")

        def __len__(self) -> NoReturn:
            kind = type(self)
            raise TypeError(f"{kind.__name__} has no length{kind._advice('len')}")

        def __bool__(self) -> bool:     # not by the length
            return True
