"""Simulate the recordings that ship with the library, and hold the files against them.

``python lab/studies/examples.py --write`` makes the files in pdavis_cv/data anew.
"""
from __future__ import annotations

import sys
import warnings

import numpy as np

import pdavis_cv
from pdavis_cv.data import example_recording
from pdavis_cv.simulation.examples import EXAMPLES, example_stream

LARGEST = 2_000_000
"""Bytes of a file: a choice, for the size of the wheel."""
SHARE = 0.01
"""By which numbers of events may differ between machines: NumPy's functions differ
in the last bit, and a crossing that is missed shifts those after it."""


def write(name: str) -> None:
    """Make the file of an example."""
    path = example_recording(name)
    with warnings.catch_warnings():  # AEDAT-4 does not mark invalid pixels
        warnings.simplefilter("ignore", pdavis_cv.PdavisWarning)
        pdavis_cv.write_aedat4(path, example_stream(name))
    print(f"wrote {path.name}: {path.stat().st_size} bytes")


def differs(name: str) -> list[str]:
    """Return what is wrong with the file of an example."""
    path = example_recording(name)
    wrong = []
    if path.stat().st_size > LARGEST:
        wrong.append(f"{path.name}: more than {LARGEST} bytes")
    made = example_stream(name)
    packets = list(made.packets())
    with pdavis_cv.open_recording(path) as kept:
        if kept.info.sensor_size != made.info.sensor_size:
            wrong.append(f"{path.name}: {kept.info.sensor_size}")
        events = kept.events()
        count = sum(len(packet.events) for packet in packets)
        if abs(len(events) - count) > SHARE * count:
            wrong.append(f"{path.name}: {len(events)} events, not {count}")
        dn = [np.clip(np.rint(frame.dn), 0, None)
              for packet in packets for frame in packet.frames]
        kept_dn = [frame.dn for packet in kept.packets() for frame in packet.frames]
        if len(dn) != len(kept_dn) or np.abs(np.subtract(dn, kept_dn)).max() > 1:
            wrong.append(f"{path.name}: other frames")
    return wrong


def main(argv: list[str] | None = None) -> int:
    """Compare, or with --write make anew; --quick takes the smaller one only."""
    argv = sys.argv[1:] if argv is None else argv
    names = ["tendon"] if "--quick" in argv else list(EXAMPLES)
    if "--write" in argv:
        for name in names:
            write(name)
    wrong = [line for name in names for line in differs(name)]
    print("\n".join(wrong) or f"{', '.join(names)}: as the files")
    return int(bool(wrong))


if __name__ == "__main__":
    raise SystemExit(main())
