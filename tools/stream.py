"""Send a recording or a live source to DV and dv-processing.

Events are at --port, frames at --frames-port: dv's reader takes one stream per
connection.  Begins when each has a client.  Others than this machine are answered with
--host, and then only by TLS and if they show a certificate that --authority signed.
"""
from __future__ import annotations

import argparse
from collections.abc import Sequence

from ._common import Parser, UsageError, add_json_option, command, tell_now
from ._interrupts import ended_by_signals
from ._options import add_file, add_source_options, source_of
from ._progress import progress_in_time, stage
from ._tls import add_tls_options, tls_of
from ._values import within


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pdavis stream``."""
    args = _parser().parse_args(argv)
    from pdavis_cv.live import LOOPBACK, DvServer

    context = tls_of(args)
    if context is not None and args.authority is None:
        raise UsageError("--certificate needs --authority: clients show a certificate "
                         "too")
    if args.host not in LOOPBACK and context is None:
        raise UsageError("--host beyond this machine needs --certificate, --key and "
                         "--authority")
    with source_of(args) as source, ended_by_signals():
        none = source.info.frame_count == 0 or args.no_frames
        with DvServer(source.info, args.port, None if none else args.frames_port,
                      compression=args.compression, host=args.host, context=context
                      ) as server:
            tell_now(args, [f"{name}: {port}" for name, port in server.ports.items()],
                     **server.ports)
            stage("waiting for a client of each")
            while not server.wait_for_clients(1):
                pass
            for packet in progress_in_time(
                    source.packets(), source.info.start_us, None):
                server.add(packet)
        tell_now(args, [f"slow clients did not get {server.dropped} packets"]
                 if server.dropped else [], dropped=server.dropped)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser("stream", __doc__ or "",
                    'pdavis stream "replay:recording.aedat4?speed=1" --port 7777')
    add_file(parser, "a recording, or the address of a live source")
    parser.add_argument("--host", default="127.0.0.1",
                        help="address to answer on, default this machine alone")
    parser.add_argument("--port", type=within(0, 65535), default=7777,
                        help="for events, default 7777; 0 = any that is free")
    parser.add_argument("--frames-port", type=within(0, 65535), default=7778,
                        help="for frames, default 7778")
    parser.add_argument("--no-frames", action="store_true", help="send events only")
    parser.add_argument("--compression", choices=("none", "lz4", "zstd"),
                        default="none", help="default none")
    add_tls_options(parser, "who must have signed a client's certificate")
    add_source_options(parser)
    add_json_option(parser)
    return parser
