"""List the cameras that are plugged in, or record what one sends word for word.

A trace of --record-raw opens as a recording, and holds everything, whatever this
program makes of it: send one if images are wrong.
"""
from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from ._common import Parser, command
from ._interrupts import ended_by_signals
from ._values import positive


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pdavis devices``."""
    args = _parser().parse_args(argv)
    if args.record_raw is not None:
        return _record(args.record_raw, args.serial, args.seconds)
    from pdavis_cv.live.camera import listed

    found = [one for one in listed() if args.serial in (None, one["serial"])]
    if args.json:
        json.dump(found, sys.stdout, indent=2)
        print()
        return 0
    for one in found:
        print(f"usb:{one['serial'] or ''}  {one['name']}, {one['connection']}"
              + (f": {one['error']}" if one["error"] else ""))
    if not found:
        print("no DAVIS346 is plugged in, or this user may not open it: see "
              "docs/live.md")
    return 0


def _record(path: Path, serial: str | None, seconds: float) -> int:
    from pdavis_cv.live.base import HEARTBEAT_S
    from pdavis_cv.live.camera import Davis346
    from pdavis_cv.recording.davis_trace import TraceWriter

    device = Davis346(serial, {})
    count = losses = 0
    try:
        with TraceWriter(path, device.info, device.orientation) as trace, (
                ended_by_signals()):
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                for one in device.read(HEARTBEAT_S) or ():
                    trace.add(one)
                    count += len(one.data)
                    losses += one.lost
    finally:
        device.close()
        print(f"{path}: {count / 1e6:.1f} MB, {losses} losses")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser("devices", __doc__ or "",
                    "pdavis devices --record-raw trace.usb --seconds 10")
    parser.add_argument("--json", action="store_true", help="print JSON instead")
    parser.add_argument("--serial", help="of one camera; default: the first, or all")
    parser.add_argument("--record-raw", metavar="FILE", type=Path,
                        help="write what the camera sends to FILE")
    parser.add_argument("--seconds", type=positive, default=10.0,
                        help="so long, default 10")
    return parser
