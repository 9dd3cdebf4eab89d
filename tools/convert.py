"""Write a recording in another format: AEDAT-4, AEDAT-2.0, HDF5 of E2P or of DSEC."""
from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

from pdavis_cv import open_recording, write_aedat2, write_aedat4
from pdavis_cv.recording.base import Recording
from pdavis_cv.recording.hdf5 import write_hdf5
from pdavis_cv.recording.passing import passing

from ._common import Parser, UsageError, command, layout_option, progress

__all__ = ["main"]

FORMATS = {".aedat4": "aedat4", ".aedat": "aedat2", ".aedat2": "aedat2",
           ".h5": "e2p", ".hdf5": "e2p"}
KINDS = ("aedat4", "aedat2", "e2p", "dsec")


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pdavis convert``."""
    args = _parser().parse_args(argv)
    out = Path(args.output)
    kind = args.format or FORMATS.get(out.suffix.lower())
    if kind is None:
        raise UsageError(f"{out.name}: no format ends in {out.suffix!r}; use --format")
    if out.exists() and not args.force:
        raise UsageError(f"{out} exists; --force replaces it")
    with open_recording(
            args.input, layout=args.layout, camera=args.camera) as recording:
        lost = _write(kind, out, passing(
            recording, lambda packets: progress(packets, None, "packets")), args)
        problems = recording.problems
    for what, count in lost.items():
        print(f"not kept: {count:,} {what}")
    for problem in problems:
        print(f"found: {problem.kind} ({problem.count:,}): {problem.message}")
    return 0


def _write(kind: str, out: Path, recording: Recording,
           args: argparse.Namespace) -> Mapping[str, int]:
    if kind == "aedat4":
        return write_aedat4(out, recording, compression=args.compression)
    if kind == "aedat2":
        return write_aedat2(out, recording)
    return write_hdf5(out, recording, flavour=kind)


def _parser() -> argparse.ArgumentParser:
    parser = Parser("convert", __doc__ or "",
                    "pdavis convert jaer-recording.aedat upright.aedat4")
    parser.add_argument("input", help="a recording of any kind")
    parser.add_argument("output", help="the file to write; its ending says the format")
    parser.add_argument("--format", choices=KINDS, help="if the ending does not")
    parser.add_argument("--compression", choices=("lz4", "none", "zstd"),
                        default="lz4", help="of AEDAT-4; default lz4")
    parser.add_argument("--layout", type=layout_option, metavar="LAYOUT",
                        help="polarizers of the 2x2 cell, kept where the format can")
    parser.add_argument("--camera", help="which camera, if the file holds several")
    parser.add_argument("--force", action="store_true", help="replace an old file")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
