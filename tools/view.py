"""Show a recording or a live source in a browser, and stream it as MJPEG.

The page asks for nothing from elsewhere.  /stream.mjpg?output=aop_bgr beside it opens
in cv2.VideoCapture, VLC and other players.
"""
from __future__ import annotations

import argparse
import contextlib
import webbrowser
from collections.abc import Sequence
from pathlib import Path

from pdavis_cv.recording.base import start_of

from ._common import Parser, UsageError, add_json_option, command, tell_now
from ._interrupts import ended_by_signals
from ._options import add_file, add_fuse_options, fusion_given, source_of
from ._tls import add_tls_options, tls_of
from ._values import within


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pdavis view``."""
    args = _parser().parse_args(argv)
    from pdavis_cv import Recording, serve
    from pdavis_cv.live import Session

    context = tls_of(args)
    with source_of(args) as source:
        options = fusion_given(args)
        for name in options.keys() & {"start_us", "stop_us"}:
            if not isinstance(source, Recording):
                raise UsageError("--start and --stop need a recording: what is live "
                                 "begins now")
            options[name] += start_of(source)
        with contextlib.ExitStack() as stack:
            shown: Recording | Session
            if isinstance(source, Recording):
                if args.record is not None:
                    raise UsageError("--record needs a live source")
                shown = source
            else:
                shown = stack.enter_context(
                    Session(source, record=args.record, **options))
                options = {}
            server = stack.enter_context(serve(
                shown, host=args.host, port=args.port, record_to=args.record_to,
                context=context,
                **options))
            with ended_by_signals():
                tell_now(args, [server.url], url=server.url)
                if not args.no_browser:
                    webbrowser.open(server.url)
                server.wait()
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser("view", __doc__ or "", 'pdavis view "simulate:fan?rpm=60"')
    add = parser.add_argument
    add_file(parser, "a recording, or the address of a live source")
    add("--host", default="127.0.0.1", help="address to answer on, default this "
        "machine alone; others need the token that is printed")
    add("--port", type=within(0, 65535), default=8346,
        help="default 8346; 0 = any that is free")
    add_tls_options(
        parser, "who must have signed a browser's certificate; default: none is asked "
        "for")
    add("--no-browser", action="store_true", help="print the address and open nothing")
    add("--record", type=Path, metavar="FILE",
        help="write what a live source sends, from its beginning, as AEDAT-4")
    add("--record-to", type=Path, default=Path(), metavar="FOLDER",
        help="where the page's record button writes, default the current folder")
    add_json_option(parser)
    add_fuse_options(parser)
    return parser
