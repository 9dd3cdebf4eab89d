"""Numbers of the estimator without another origin: what half and twice of each changes.

    python lab/studies/constants.py [--quick] [NAME ...]

Each of `NUMBERS` is set to half and to twice its value wherever it is.  Its row has
the errors of AoP and DoLP in the cells that it matters in, of two cameras each, x those
of today's value (geometric mean, least and largest), and by how much the share of them
within one sigma changes.  No table has these cameras.  A number must be changed if half
or twice of it is better by more than 3 % everywhere.
"""
from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, nullcontext
from typing import Any
from unittest import mock

import numpy as np

from lab.evidence import run
from lab.evidence.cases import CASES, Case
from pdavis_cv.simulation import Texture

CAMERAS = (("typical", 1001), ("davis346", 1002), ("drawn", 1001)) * 2
BETTER = 0.97
KALMAN, LIVE, EVENTS = "kalman", "kalman causal", "events, redundancy"
WEAK, SLOW, TURNS = "polarizer-20-0.1", "polarizer-30-0.3", "polarizer-200-0.5"
FAST, BLACK, PLATE = "polarizer-1000-1", "black-30-200-0.5", "plate-200-0.5"
DARK, STILL, TEXTURE, EDGES = "dark-60", "still-10", "texture-200", "edges-200"
FIT, SHAPE, DIM = (SLOW, FAST, BLACK), (SLOW, TEXTURE, EDGES), (DARK, STILL)
LOST, DEAD = ("missing-half-60", STILL), ("refractory-1-200", FAST)
PLAIN = {"unpolarized": Case(light=lambda seed: Texture(
    velocity=(120.0, 35.0), seed=seed, dolp=0.0, dolp_spread=0.0))}
NUMBERS = (
    ("pixel.learn", "STEP ROUNDS COMMON_ERROR COMMON_PAIRS EVIDENCE MODEL_ERROR SPREAD "
     "MOST_SEARCHED MOST_TRIED MOST_FURTHER LAG MOST_LACKING "
     "Priors.theta_sigma Priors.bandwidth Priors.bandwidth_sigma", FIT, KALMAN),
    ("pixel.learn", "BETTER_REST RESTS_S", (*SHAPE, STILL), KALMAN),
    ("pixel.learn", "LOSS_OF_BLACK SIGMAS BLACK LEAST_BLACK MOST_LEFT",
     (BLACK, "black-80-200-1", FAST, "flicker-200"), KALMAN),
    ("pixel.learn", "LEAST_WHOLE", LOST, KALMAN),
    ("pixel.features", "SHRINKS FOLDS WITHIN SAME_SCALE", FIT, KALMAN),
    ("pixel.frame_noise", "FAR LEAST MOST DIM_DN", (*DIM, TURNS), KALMAN),
    ("pixel.model", "SHORT_US _LEAST_VARIANCE AROUND_S PixelModel.noise", FIT, KALMAN),
    ("pixel.model", "PAST_S", (TURNS, TEXTURE), LIVE),
    ("pixel.model", "PixelModel.read_variance PixelModel.shot", (*DIM, TURNS), KALMAN),
    ("pixel.rows", "LEAST_PASSED MOST_PASSED EDGE_US MOST_ROWS MOST_PER_PAIR",
     (WEAK, *SHAPE), KALMAN),
    ("pixel.rows", "LEAST_NOISE LEAST_VARIANCE LOSS", FIT, KALMAN),
    ("pixel.rows", "MISSING OF_INTERVAL LEAST_DN", (*LOST, DARK), KALMAN),
    ("pixel.silences", "STRENGTH SAME SILENCES PIXELS LATER_US", SHAPE, KALMAN),
    ("pixel.silences", "SHORTEST LEAST_LOST LARGEST_ERROR", DEAD, KALMAN),
    ("fusion.online_learning", "FIRST_LOOK_S _DELAY", (TURNS, TEXTURE), LIVE),
    ("reconstruct.kalman.lasting_degree", "FRAMES LATE_FRAMES FIRST_ERROR SURE",
     (TURNS, "lost-200", EDGES, "unpolarized"), KALMAN),
    ("reconstruct.kalman.saturation", "VALID_VARIANCE EXCESS PRIOR_SIGMA DIM_VARIANCE",
     ("saturated-200", DARK), KALMAN),
    ("reconstruct.redundancy", "STEP_US SOLVE_EVERY LEAST WINDOW MEMORY PART_LEAST "
     "PULL VALID_QUALITY REST_S", (PLATE, "polarizer-60-1"), EVENTS))
"""Module, names, cells, method."""


def errors(cell: str, method: str, preset: str, seed: int) -> tuple[float, ...]:
    """Return errors of AoP and DoLP, and the shares of them within one sigma."""
    with mock.patch.dict(CASES, PLAIN):
        row, = run.simulated_rows(
            cell, preset, seed, {method: run.known(slow=True)[method]})
    return row.aop_deg, row.dolp, row.aop_covered, row.dolp_covered


def scaled(value: Any, factor: float) -> Any:
    """Return a number, or all of several, times a factor; integers stay integers."""
    if isinstance(value, tuple):
        return tuple(scaled(each, factor) for each in value)
    return max(round(value * factor), 1) if isinstance(value, int) else value * factor


@contextmanager
def changed(module: str, name: str, factor: float) -> Iterator[None]:
    """Scale a number in all modules that hold it, or the default of a dataclass."""
    of, _, field = name.rpartition(".")
    holder = importlib.import_module(f"pdavis_cv.{module}")
    held = [getattr(holder, of).__init__.__kwdefaults__] if of else [
        vars(one) for key, one in sys.modules.items() if key.startswith("pdavis_cv.")
        and vars(one).get(field) is vars(holder)[field]]
    old = held[0][field]
    for one in held:
        one[field] = scaled(old, factor)
    try:
        yield
    finally:
        for one in held:
            one[field] = old


def measured(job: tuple[Any, ...]) -> tuple[float, ...]:
    """Return the `errors` of a cell with a number scaled; factor 1: as it is."""
    *number, cell, method, camera = job
    with nullcontext() if number[-1] == 1 else changed(*number):
        return errors(cell, method, *camera)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; return 1 if a number must be changed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="of the table; default all")
    parser.add_argument("--quick", action="store_true", help="some, of one camera")
    args = parser.parse_args(argv)
    table = [(module, name, cells, [
        (cell, method, one) for i, cell in enumerate(cells[:1] if args.quick else cells)
        for one in CAMERAS[i % 3:][:2]]) for module, names, cells, method in NUMBERS
             for name in names.split() if not args.names or name in args.names]
    table = table[::20] if args.quick else table
    jobs = list(dict.fromkeys(
        (*number, *each) for module, name, _, where in table for each in where
        for number in (("", "", 1), (module, name, 0.5), (module, name, 2))))
    with ProcessPoolExecutor(2) as pool:
        found = dict(zip(jobs, map(np.array, pool.map(measured, jobs)), strict=True))
    print("| number | cells | half: AoP | DoLP | within | twice: AoP | DoLP | within |")
    print("|---|---|---|---|---|---|---|---|")
    better = []
    for module, name, cells, where in table:
        line = f"| `{module}.{name}` | {', '.join(cells)} "
        for factor in (0.5, 2):
            old, new = (np.array([found[*number, *each] for each in where]) for number
                        in (("", "", 1), (module, name, factor)))
            ratio, more = new[:, :2] / old[:, :2], np.nanmean(new[:, 2:] - old[:, 2:])
            for one in ratio.T:
                line += (f"| {np.exp(np.nanmean(np.log(one))):.3f} "
                         f"({np.nanmin(one):.2f} to {np.nanmax(one):.2f}) ")
            line += f"| {more:+.3f} "
            better += [f"{name} x {factor:g}"] if np.nanmax(ratio) < BETTER else []
        print(line + "|")
    print("better everywhere, must be CHANGED:", ", ".join(better) or "none")
    return 1 if better else 0


if __name__ == "__main__":
    sys.exit(main())
