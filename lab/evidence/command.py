"""python -m lab.evidence: every method on many cases, beside two that need no library.

A case is light before a simulated camera, or a real recording with frames left out;
together with the preset of the camera it is a cell of the table.  Errors are those of
AoP (degrees) and DoLP of super-pixels, or of left-out frames (ln DN) where pixels move
and in their cells; coverage is the part of errors within one sigma (0.68 if sigmas are
right).  Mean over seeds.
"""
from __future__ import annotations

import argparse
import dataclasses
import fnmatch
import functools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from lab.paper.print_style import beside_stem
from pdavis_cv import __version__
from pdavis_cv._beside import write_beside
from pdavis_cv.batch.processes import ProcessPool
from pdavis_cv.tools._common import (
    Parser,
    UsageError,
    add_json_option,
    checked_out,
    command,
    for_people,
    tell,
)
from pdavis_cv.tools._progress import progress
from pdavis_cv.tools._values import within

from .cases import CASES, NAMED, PRESETS, QUICK, REAL
from .page import page
from .run import Row, known, quiet, real_rows, simulated_rows

FIRST_SEED, FIRST_DEVELOPMENT_SEED = 201, 1001

Task = Callable[[], list[Row]]
Cell = tuple[str, str]


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Simulate, score, and write the table; return 0."""
    args = _parser().parse_args(argv)
    if args.out is not None:
        checked_out(args.out)
    methods = _methods(args.methods)
    cells = _cells(args)
    first = FIRST_DEVELOPMENT_SEED if args.development else FIRST_SEED
    seeds = range(first, first + (args.seeds or (1 if args.quick else 3)))
    tasks = list(_tasks(cells, seeds, methods, args.recording))
    if not tasks:
        raise UsageError("no case of this name, or it needs --recording")
    rows: list[Row] = []
    with for_people(args):
        for found in progress(_done(tasks, args.jobs), len(tasks), "recordings"):
            rows += found
            if args.out is not None:
                _write(args.out, rows, seeds)
    tell(args, page(rows, seeds), pdavis_cv=__version__, seeds=list(seeds),
         rows=list(map(dataclasses.asdict, rows)))
    return 0


def _done(tasks: Sequence[Task], jobs: int) -> Iterator[list[Row]]:
    if jobs == 1:
        quiet()
        yield from (task() for task in tasks)
        return
    with ProcessPool(jobs) as pool:
        yield from pool.map(_call, tasks)


def _call(task: Task) -> list[Row]:
    quiet()
    return task()


def _tasks(
    cells: Iterable[Cell], seeds: Iterable[int], methods: Mapping[str, str],
    recordings: Sequence[Path],
) -> Iterator[Task]:
    for name, preset in cells:
        if preset == "real":
            for path in recordings:
                yield functools.partial(real_rows, path, name, methods)
        else:
            for seed in seeds:
                yield functools.partial(simulated_rows, name, preset, seed, methods)


def _cells(args: argparse.Namespace) -> list[Cell]:
    """Return the cells asked for: of the named or quick ones, or of all."""
    if args.named or args.quick:
        cells = list(dict.fromkeys(
            [*(NAMED if args.named else ()), *(QUICK if args.quick else ())]))
    else:
        cells = [(name, preset) for name in CASES for preset in PRESETS]
        cells += [(name, "real") for name in REAL]
    return [(name, preset) for name, preset in cells
            if preset in (*args.presets, "real") and (
                any(fnmatch.fnmatchcase(name, one) for one in args.cases) if args.cases
                else preset == "real" or CASES[name].usual)]


def _methods(patterns: Sequence[str] | None) -> dict[str, str]:
    if patterns is None:
        return known()
    found = {name: ahead for name, ahead in known(slow=True).items()
             if any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)}
    if not found:
        raise UsageError(f"--methods must name some of {', '.join(known(slow=True))}")
    return found


def _write(stem: Path, rows: Sequence[Row], seeds: Sequence[int]) -> None:
    """Write STEM.json and STEM.md; anew after each recording, so none is lost."""
    with write_beside(beside_stem(stem, ".json")) as part:
        part.write_text(json.dumps({
            "pdavis_cv": __version__, "seeds": list(seeds),
            "rows": [{key: None if isinstance(value, float) and math.isnan(value)
                      else value for key, value in dataclasses.asdict(row).items()}
                     for row in rows]}, indent=1) + "\n", encoding="utf-8")
    with write_beside(beside_stem(stem, ".md")) as part:
        part.write_text("\n".join(page(rows, seeds)).rstrip() + "\n", encoding="utf-8")


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        "evidence", __doc__ or "",
        "python -m lab.evidence 'polarizer-200-*' --methods 'kalman*' "
        "--presets typical --seeds 3")
    parser.prog = "python -m lab.evidence"
    parser.add_argument(
        "cases", nargs="*", metavar="CASE",
        help="names or patterns, such as 'texture-*'; default all but those of 5 "
             f"minutes; of {', '.join(CASES)}; with --recording of {', '.join(REAL)}")
    parser.add_argument(
        "-o", "--out", type=Path, metavar="STEM",
        help="write STEM.md and STEM.json, anew after each recording")
    parser.add_argument(
        "--methods", nargs="+", metavar="NAME",
        help="names or patterns; default all usual ones and the peers; of "
             f"{', '.join(map(repr, known(slow=True)))}")
    parser.add_argument(
        "--presets", nargs="+", choices=PRESETS, default=PRESETS, metavar="PRESET",
        help=f"cameras; default all of {', '.join(PRESETS)}")
    parser.add_argument(
        "--seeds", type=within(1, 50), metavar="N",
        help="how many cameras of each preset, default 3 (1 with --quick), from seed "
             f"{FIRST_SEED} on")
    parser.add_argument(
        "--development", action="store_true",
        help=f"seeds from {FIRST_DEVELOPMENT_SEED} on, on which constants may be "
             "chosen; they are not reported")
    parser.add_argument(
        "--named", action="store_true",
        help="only the cells on which an estimator is judged first")
    parser.add_argument(
        "--quick", action="store_true", help="these and one of each other kind")
    parser.add_argument(
        "--recording", type=Path, nargs="+", default=[], metavar="FILE",
        help="real recordings, every second frame of which is left out")
    parser.add_argument(
        "--jobs", type=within(1, 256), default=1, metavar="N",
        help="processes; default 1")
    add_json_option(parser)
    return parser
