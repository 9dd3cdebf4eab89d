"""What a pixel has crossed since its last event, nothing known beyond: the prior.

Writes ``_kernels/_extrapolation.h``, which `ahead` in ``_kernels/_tracks.pxd`` reads::

    python lab/studies/kalman_extrapolation.py --write      # rewrite the table
    python lab/studies/kalman_extrapolation.py              # compare with other draws

The prior of what pixels see is an ensemble of turning polarizers (`PRIOR`): light of
log intensity ln(1 + m cos phi), phi growing evenly, seen by a low-pass pixel that makes
an event at every crossing of a threshold, now and then one of noise.  Let gap be the
interval between a pixel's last two events and u = (t - t_last) / gap.  Of all moments t
at which no event has followed yet, so many of either kind (both events of one sign, or
the light has turned), the mean and the variance of

* the part: log intensity since the last event, in thresholds, in its direction;
* its slope, in thresholds per gap,

are those of the light that is still moving; light that stopped after the last event, at
a constant hazard per gap, is at rest with the mean 0 and the variance of a uniform
distribution over the dead band.  Silence is evidence: the longer, the more likely is
rest (censored data, weighted by the probability of no event in u).  Of light that moves
the table also has what a sample during the silence needs (``_sampled_part.h``): the
standard deviation of the part, its mean at half of the time u, and the covariance of
both over half of the variance, 1 where they grow in proportion.

No camera, preset or recording of the package is used here.
"""
from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from common import Found, main

HEADER = Path(__file__).resolve().parents[2] / "_kernels" / "_extrapolation.h"

PRIOR = {
    "depth": (0.28, 0.95),          # m: DoLP of .3 to 1, extinction ratio 40
    "theta": (0.1, 0.3),            # thresholds, natural-log units
    "ratio_sigma": 0.1,             # of ln(theta_on / theta_off)
    "corner": (3.0, 100.0),         # low-pass, multiples of the light's frequency
    "noise": 0.01,                  # noise events per event
    "stop": 0.02,                   # hazard that the light stops, per gap
}
REST_VARIANCE = 1 / 3               # uniform in -1..1 thresholds
LEAST_SPREAD = 0.01                 # thresholds; numerical
# Nodes in u: by 1/16 to 2, by 1/2 from there; beyond the last the light is at rest.
FINE, COARSE, LAST = 1 / 16, 1 / 2, 10.0
NODES = np.concatenate([np.arange(0, 2, FINE), np.arange(2, LAST + COARSE, COARSE)])
PHASES = 2048
COLUMNS = ("fraction", "rate", "var", "rate_var", "moving", "spread", "middle",
           "common")
# Values of a row of the header: a power of two, so that rows are read whole.
PITCH = 8


def shown(depth: float, corner: float) -> np.ndarray:
    """Log intensity over one turn of the light, as a low-pass pixel shows it."""
    light = np.log1p(depth * np.cos(np.arange(PHASES) * 2 * np.pi / PHASES))
    harmonics = np.arange(PHASES // 2 + 1)
    return np.fft.irfft(np.fft.rfft(light) / (1 + 1j * harmonics / corner), PHASES)


def events(
    rng: np.random.Generator, level: np.ndarray, on: float, off: float, *,
    noise: float = PRIOR["noise"],
) -> Iterator[tuple[float, int, float]]:
    """Yield (time, sign, sum) of events over two turns, times in steps of the grid.

    The sum is that of the events, from the log intensity at the start on.
    """
    level = np.tile(level, 4)
    at = rng.uniform(0, PHASES)
    stop = at + 2 * PHASES
    held = np.interp(at, np.arange(len(level)), level)
    while at < stop:
        first = int(at) + 1
        rest = level[first:first + PHASES] - held
        beyond = (rest >= on) | (rest <= -off)
        if not beyond.any():
            return
        i = int(np.argmax(beyond))
        sign = 1 if rest[i] > 0 else -1
        step = on if sign > 0 else -off
        before = level[first + i - 1] - held
        t = max(at, first + i - 1 + (step - before) / (rest[i] - before))
        if rng.random() < noise:
            t, sign = rng.uniform(at, t), int(rng.choice((-1, 1)))
            step = on if sign > 0 else -off
        held += step
        at = t
        yield t, sign, held


def moments(draws: int, seed: int) -> np.ndarray:
    """Sum over moments without an event.

    Returns (kind, node, (n, x, x^2, slope, slope^2, y, x y)), where y is the part at
    half the time since the last event.
    """
    rng = np.random.default_rng(seed)
    sums = np.zeros((2, len(NODES), 7))
    for _ in range(draws):
        depth = rng.uniform(*PRIOR["depth"])
        corner = np.exp(rng.uniform(*np.log(PRIOR["corner"])))
        theta, ratio = rng.uniform(*PRIOR["theta"]), np.exp(
            PRIOR["ratio_sigma"] / 2 * rng.standard_normal())
        on, off = theta * ratio, theta / ratio
        level = shown(depth, corner)
        slopes = (np.roll(level, -1) - np.roll(level, 1)) / 2
        found = list(events(rng, level, on, off))
        for (t0, p0, _), (t1, p1, held), (t2, _, _) in zip(
                found[:-2], found[1:-1], found[2:], strict=True):
            gap = max(t1 - t0, 1e-3)
            u = NODES[t1 + NODES * gap < t2]
            t = (t1 + u * gap) % PHASES
            turn, phases = np.append(level, level[0]), np.arange(PHASES + 1)
            here = np.interp(t, phases, turn)
            half = np.interp((t1 + u * gap / 2) % PHASES, phases, turn)
            unit = on if p1 > 0 else off
            # From the sum of events, which noise moves too: at most a threshold away.
            x, y = p1 * (here - held) / unit, p1 * (half - held) / unit
            slope = p1 * slopes[t.astype(int) % PHASES] * gap / unit
            kind = int(p0 != p1)
            sums[kind, :len(u)] += np.stack(
                [np.ones(len(u)), x, x**2, slope, slope**2, y, x * y], 1)
    return sums


def table(draws: int = 600, seed: int = 1) -> np.ndarray:
    """Return (kind, node, column): kinds same sign and turned, columns `COLUMNS`."""
    sums = moments(draws, seed)
    n = np.maximum(sums[..., :1], 1e-12)
    mean, second, slope, second_slope, middle, product = np.moveaxis(
        sums[..., 1:] / n, -1, 0)
    spread = np.maximum(second - mean**2, LEAST_SPREAD**2)
    common = np.clip(2 * (product - mean * middle) / spread, 0, 1)
    silent = sums[..., 0] / sums[:, :1, 0]          # probability of no event in u
    moving = np.exp(-PRIOR["stop"] * NODES) * silent
    # The light stops while there is no event yet: integrate the hazard over u.
    steps = np.diff(NODES, prepend=0)
    stopped = np.cumsum(PRIOR["stop"] * moving * steps, axis=1)
    share = moving / (moving + stopped)
    mean, slope = share * mean, share * slope
    var = share * second + (1 - share) * REST_VARIANCE - mean**2
    var = np.minimum(var, REST_VARIANCE)
    rate_var = share * second_slope - slope**2
    # Beyond the last node the light is at rest.
    mean[:, -1] = slope[:, -1] = rate_var[:, -1] = 0
    var[:, -1] = REST_VARIANCE
    share[:, -1] = 0
    return np.stack(
        [mean, slope, var, rate_var, share, np.sqrt(spread), middle, common], -1)


def header(values: np.ndarray) -> str:
    """Return the text of the header that holds a table."""
    rows = [f"    {{{', '.join(f'{number:.4f}' for number in node)}}},"
            for kind in values for node in kind]
    half = len(NODES)
    return "\n".join([
        "/* Part of a threshold crossed since a pixel's last event: see `ahead`.",
        "",
        "   Made by lab/studies/kalman_extrapolation.py.  By kind (the",
        "   last two events of one sign; of two) and node (u = time since the last",
        "   event over the gap before it, by AHEAD_FINE to 2, then by AHEAD_COARSE):",
        "   mean part in thresholds, its slope in thresholds per gap, variances of",
        "   both, probability that the light still moves. */",
        "#ifndef PDAVIS_CV_EXTRAPOLATION_H",
        "#define PDAVIS_CV_EXTRAPOLATION_H",
        "",
        f"#define AHEAD_NODES {half}",
        f"#define AHEAD_PITCH {PITCH}",
        f"#define AHEAD_FINE {FINE}",
        f"#define AHEAD_COARSE {COARSE}",
        f"#define AHEAD_KNEE {round(2 / FINE)}",
        "",
        "static const float AHEAD[2 * AHEAD_NODES][AHEAD_PITCH] = {",
        *rows[:half], "", *rows[half:], "};", "", "#endif", ""])


def stored() -> np.ndarray:
    """Return the table that the header holds, as `table` does."""
    rows = re.findall(r"\{([-\d., ]+)\}", HEADER.read_text())
    numbers = [[float(number) for number in row.split(",")] for row in rows]
    return np.array(numbers).reshape(2, len(NODES), len(COLUMNS))


def study(quick: bool) -> list[Found]:
    """How far a table made anew, from other draws, lies from the one in the kernel."""
    new, old = table(150 if quick else 600, seed=2), stored()
    # Later, few moments without an event are left; at once, parts hardly differ.
    early = (NODES < 1.5) & (NODES > 0.25)
    change = np.abs(new - old)[:, early]
    # The covariance after a turn depends on few draws.
    limits = {
        "one sign": {"fraction": 0.03, "rate": 0.1, "var": 0.03, "spread": 0.03,
                     "middle": 0.02, "common": 0.2},
        "turned": {"fraction": 0.2, "rate": 1.2, "var": 0.25, "spread": 0.4,
                   "middle": 0.3}}
    return [
        Found(f"_extrapolation.h: change of {column}, {kind}", float(
            change[i, :, COLUMNS.index(column)].max()), limit, at_least=True)
        for i, (kind, of_kind) in enumerate(limits.items())
        for column, limit in of_kind.items()]


if __name__ == "__main__":
    if "--write" in sys.argv[1:]:
        HEADER.write_text(header(table()))
    else:
        raise SystemExit(main(study))
