"""python -m lab.bench: time what this library does against fixed floors.

A ratio is the median of interleaved pairs of runs, floor then candidate, in one
thread on one core; of several inputs the worst counts.  Before anything is timed,
the candidate must equal an independent evaluation.  Only ratios are judged; absolute
figures depend on the machine.
"""
from __future__ import annotations

import contextlib
import json
import os
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pdavis_cv._beside import write_beside
from pdavis_cv.tools._common import Parser, UsageError, can_draw, command
from pdavis_cv.tools._values import within

from . import (  # noqa: F401  # they register their cases
    demosaic,
    event_files,
    events,
    files,
    images,
    kalman,
    network,
    simulate,
    streams,
    turning,
    usb,
)
from .cases import CASES, Case, Comparison
from .picture import Curve, draw

PAIRS = 15


@dataclass(frozen=True)
class Result:
    """How one input of a case did.

    Parameters
    ----------
    case, input : str
        Names.
    ratio : float
        Median over the pairs; above 1 means faster than the floor, for a case that
        is judged by speed, and slower for one that is judged by time.
    ratio_quartiles : (float, float)
        First and third quartile over the pairs.
    goal : float
        What the ratio must reach, or stay below for a case judged by time.
    reached : bool or None
        None where the goal is not meant for this input.
    candidate, floor : float
        Median figures in ``unit``.
    unit : str
    at : (str, float) or None
        Name of an axis and the input's position on it.
    """

    case: str
    input: str
    ratio: float
    ratio_quartiles: tuple[float, float]
    goal: float
    reached: bool | None
    candidate: float
    floor: float
    unit: str
    at: tuple[str, float] | None


def measure(case: Case, pairs: int = PAIRS) -> list[Result]:
    """Return a result per input of the case.

    Raises
    ------
    AssertionError
        If the candidate does not equal the independent evaluation.
    """
    return [_measure(case, comparison, pairs) for comparison in case.comparisons()]


def _measure(case: Case, comparison: Comparison, pairs: int) -> Result:
    comparison.check()
    times = [(comparison.floor(), comparison.candidate())
             for _ in range(pairs + 1)]
    times = times[1:]  # the first pair warms the caches
    if case.by_time:
        ratios = [candidate / floor for floor, candidate in times]
    else:
        ratios = [floor / candidate for floor, candidate in times]
    ratio = statistics.median(ratios)
    low, _, high = statistics.quantiles(ratios, n=4, method="inclusive")
    floor, candidate = (
        comparison.figure(statistics.median(column))
        for column in zip(*times, strict=True))
    reached = ratio <= case.goal if case.by_time else ratio >= case.goal
    return Result(
        case.name, comparison.name, ratio, (low, high), case.goal,
        reached if comparison.judged else None, candidate, floor, comparison.unit,
        comparison.at)


@contextlib.contextmanager
def _one_core() -> Iterator[None]:
    """Keep this process and its children on one core, where the system can."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def _line(result: Result) -> str:
    low, high = result.ratio_quartiles
    sign = "<=" if CASES[result.case].by_time else ">="
    verdict = "not judged" if result.reached is None else (
        f"goal {sign} {result.goal:g}  {'reached' if result.reached else 'MISSED'}")
    return (
        f"  {result.input:<28} {result.candidate:9.3f} {result.floor:9.3f} "
        f"{result.unit:<5}  {result.ratio:6.3f} ({low:.3f} .. {high:.3f}) "
        f"{verdict}")


def _write(
    stem: Path, summary: dict[str, Any], results: Sequence[Result],
) -> list[Path]:
    """Write STEM.json and, if there is something to draw, STEM.png; return which."""
    written = [stem.with_name(stem.name + ".json")]
    with write_beside(written[0]) as part:
        part.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    curves: dict[str, dict[str, Curve]] = {}
    for result in results:
        if result.at is not None:
            axis, x = result.at
            curves.setdefault(axis, {}).setdefault(result.case, []).append(
                (x, result.candidate))
    if curves and can_draw():
        written.append(stem.with_name(stem.name + ".png"))
        with write_beside(written[1]) as part:
            draw(curves).savefig(part, format="png", dpi=110)
    return written


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; return 0 if every goal is reached, 1 if not."""
    parser = Parser("bench", __doc__ or "", "python -m lab.bench --pairs 5 -o bench")
    parser.prog = "python -m lab.bench"
    parser.add_argument("cases", nargs="*", metavar="CASE",
                        help=f"which to run (default all): {', '.join(CASES)}")
    parser.add_argument("--pairs", type=within(0, 10_000), default=PAIRS,
                        help=f"interleaved pairs per input (default {PAIRS})")
    parser.add_argument("--json", action="store_true", help="print JSON instead")
    parser.add_argument(
        "-o", "--out", type=Path, metavar="STEM",
        help="write STEM.json and, with matplotlib, STEM.png: time against events per "
             "second and against pixels, of the cases that have several")
    args = parser.parse_args(argv)
    unknown = [name for name in args.cases if name not in CASES]
    if unknown:
        raise UsageError(f"no case {unknown[0]!r}; there are {', '.join(CASES)}")
    if args.pairs < 2:
        raise UsageError(f"--pairs must be at least 2, got {args.pairs}")
    results: list[Result] = []
    skipped: dict[str, str] = {}
    with _one_core():
        for name in args.cases or CASES:
            try:
                found = measure(CASES[name], args.pairs)
            except ImportError as error:
                skipped[name] = str(error)
                if not args.json:
                    print(f"{CASES[name].title}\n  skipped: {error}")
                continue
            results += found
            if not args.json:
                print(CASES[name].title)
                print(f"  {'':<28} {'this':>9} {'floor':>9} {'':<5}  ratio (quartiles)")
                print("\n".join(map(_line, found)), flush=True)
    summary: dict[str, Any] = {
        "pairs": args.pairs, "results": [asdict(result) for result in results],
        "skipped": skipped}
    written = [] if args.out is None else _write(args.out, summary, results)
    if args.json:
        print(json.dumps({**summary, "wrote": list(map(str, written))}, indent=2))
    elif written:
        print("wrote", *written)
    return 0 if all(r.reached is not False for r in results) else 1
