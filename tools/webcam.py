"""Show a recording or a live source as a webcam, to programs that take nothing else.

It needs a virtual camera of the system: v4l2loopback on Linux, OBS elsewhere.
"""
from __future__ import annotations

import argparse
from collections.abc import Sequence

from pdavis_cv._opencv import opencv
from pdavis_cv._packages import package

from ._common import Parser, UsageError, add_json_option, command, tell_now
from ._interrupts import ended_by_signals
from ._options import add_file, add_fuse_options, fusion_given, source_given


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pdavis webcam``."""
    args = _parser().parse_args(argv)
    from pdavis_cv import VideoCapture
    pyvirtualcam = package("pyvirtualcam", "a virtual camera needs a package: pip "
                           "install pyvirtualcam (extra [webcam])")
    sent = 0
    with VideoCapture(args.file, output=args.output, **source_given(args),
                      **fusion_given(args)) as capture, ended_by_signals():
        ok, picture = capture.read()
        if not ok or picture is None:
            raise UsageError(capture.last_error or f"{args.file}: no image")
        height, width = picture.shape[:2]
        try:
            camera = pyvirtualcam.Camera(
                width, height, capture.get(opencv().CAP_PROP_FPS),
                fmt=pyvirtualcam.PixelFormat.BGR, device=args.device)
        except RuntimeError as error:   # none is there
            raise UsageError(" ".join(str(error).split())) from None
        device = camera.device
        tell_now(args, [f"{device}: {width}x{height}, {camera.fps:g} per second"],
                 device=device)
        try:
            with camera:
                while ok and picture is not None:
                    camera.send(picture)
                    camera.sleep_until_next_frame()
                    sent += 1
                    ok, picture = capture.read()
        except (RuntimeError, ArithmeticError) as error:    # it is gone
            raise OSError(f"{device}: {error}") from None
    tell_now(args, [f"{sent} images"], images=sent)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser("webcam", __doc__ or "",
                    "pdavis webcam recording.aedat4 --fps 30 --output aop_bgr")
    add_file(parser, "a recording, or the address of a live source")
    parser.add_argument(
        "--output", choices=("bgr", "aop_bgr", "dolp_bgr", "events_bgr"),
        default="aop_bgr", help="picture to show, default aop_bgr")
    parser.add_argument("--device", help="virtual camera, e.g. /dev/video10; default: "
                        "the first that is free")
    add_json_option(parser)
    add_fuse_options(parser)
    return parser
