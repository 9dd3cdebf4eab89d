"""Write a recording in another format; the formats are listed below."""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from pdavis_cv.recording.facts import assumptions
from pdavis_cv.recording.registry import FORMATS, writer_for
from pdavis_cv.recording.stream import source_from_packets

from ._common import Parser, UsageError, add_json_option, checked_out, command, tell
from ._options import add_file, add_source_options, opened
from ._progress import progress_in_time


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pdavis convert``."""
    args = _parser().parse_args(argv)
    out = Path(args.output)
    kind, write = writer_for(out, args.format)
    options = {name: value for name in ("compression", "encoding")
               if (value := getattr(args, name)) is not None}
    for name in options.keys() - set(kind.write_options):
        raise UsageError(f"--{name} is no option of {kind.title}")
    checked_out(out, args.input, recording=True, force=args.force)
    with opened(args, args.input) as recording:
        ends = recording.info.start_us, recording.info.stop_us
        lost = write(out, source_from_packets(
            recording.info, progress_in_time(recording.packets(), *ends)), **options)
        problems = recording.problems
        assumed = assumptions(recording.info.facts)
    tell(args, [
        f"wrote {out}", *assumed,
        *(f"not kept: {count:,} {what}" for what, count in lost.items()),
        *(f"found: {one.kind} ({one.count:,}): {one.message}" for one in problems)],
        wrote=[out], assumed=assumed, not_kept=lost, problems=[
            {"kind": one.kind, "count": one.count, "message": one.message}
            for one in problems])
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser("convert", __doc__ or "",
                    "pdavis convert jaer-recording.aedat upright.aedat4\n\n" + _table())
    add = parser.add_argument
    add_file(parser, "a recording of any format", "input")
    add("output", help="the file to write; its suffix determines the format")
    add("--format", metavar="NAME", help="format, if the suffix does not determine it: "
        + ", ".join(name for name, one in FORMATS.usable().items() if one.writer))
    add("--encoding", metavar="NAME", help="how events are encoded: evt3 (default) or "
        "evt2 in RAW; event_camera_msgs (default) or dvs_msgs in a bag")
    add("--compression", choices=("lz4", "none", "zstd"),
        help="compression of AEDAT-4; default lz4")
    add_source_options(parser)
    add("--force", action="store_true", help="replace an existing recording")
    add_json_option(parser)
    return parser


def _table() -> str:
    """Return what is read and written, a format per line."""
    rows = [("name", "read", "written", "holds", "format"), *(
        (one.name, " ".join(one.suffixes), " ".join(one.written),
         ", ".join(sorted(one.holds)), one.title + f" (extra {one.extra})" * bool(
             one.extra)) for one in FORMATS.usable().values())]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "formats:\n" + "\n".join("  " + "  ".join(
        cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows)
