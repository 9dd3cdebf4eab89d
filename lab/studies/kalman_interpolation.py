"""Errors of what `between`, `quiet` and `lead` say of a pixel, as constants state them.

``_kernels/_tracks.pxd`` and ``_kernels/_lag.pxd`` name variances of interpolation and
of the lag; this script measures them on the ensemble of turning polarizers of
``kalman_extrapolation.py`` (no camera or preset of the package)::

    python lab/studies/kalman_interpolation.py

prints by what factor the two differ: the constants are rounded to what covers the
errors of simulated cameras, and stay within 4.  Parts are in thresholds, slopes in
thresholds per gap between the two events.

`LOST_FROM` and `LOST_SLOPE` are the line through the root mean square errors of log
intensity, from events of pixels whose corner frequency follows the light (`LAGS`), over
the fall c = |dy/dt| k I / (2 pi (f0 + k I)^2) that the events show.
"""
from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np
from common import Found, main
from kalman_extrapolation import PHASES, PRIOR, events, shown

KERNELS = Path(__file__).resolve().parents[2] / "_kernels"
PARTS = ("SAME", "TURNED", "UNSURE", "QUIET")
LAGS = {
    "corner": (0.5, 30.0),          # f0 + k I in the mean, multiples of the light's
    "constant": (0.0, 0.5),         # f0 over that
}
FALLS = np.arange(0.2, 0.61, 0.05)  # edges of c; few events show a faster fall


def stated() -> dict[str, float]:
    """Return the constants that the kernels define."""
    text = "".join((KERNELS / name).read_text() for name in ("_tracks.pxd", "_lag.pxd"))
    return {name: float(value) for name, value in re.findall(
        r"#define (\w+) (-?[\d.]+)", text)}


def parabola(s: np.ndarray, last: float, following: float, q: float | None):
    """Part and slope between two events of opposite signs (see `between`)."""
    half, whole = (np.sqrt(3) - 1) / 2, np.sqrt(2) - 1
    turn = half if q is None else float(np.clip(
        (last - q * q * following) / (2 * (last + q * following)), 0, whole))
    return s * (s - 2 * turn) / (1 - 2 * turn), (2 * s - 2 * turn) / (1 - 2 * turn)


def measured(draws: int = 200, seed: int = 3) -> dict[str, float]:
    """Return the mean square errors of parts and slopes, by the kernels' names."""
    rng = np.random.default_rng(seed)
    errors: dict[str, list[np.ndarray]] = {name: [] for name in PARTS}
    s = (np.arange(16) + 0.5) / 16
    for _ in range(draws):
        depth = rng.uniform(*PRIOR["depth"])
        corner = np.exp(rng.uniform(*np.log(PRIOR["corner"])))
        theta = rng.uniform(*PRIOR["theta"])
        ratio = np.exp(PRIOR["ratio_sigma"] / 2 * rng.standard_normal())
        on, off = theta * ratio, theta / ratio
        level = shown(depth, corner)
        slopes = (np.roll(level, -1) - np.roll(level, 1)) / 2
        # Events of noise are process noise of the filter, not of interpolation.
        found = list(events(rng, level, on, off, noise=0.0))
        for (t0, p0, _), (t1, p1, held), (t2, p2, _) in zip(
                found[:-2], found[1:-1], found[2:], strict=True):
            gap = max(t2 - t1, 1e-3)
            t = (t1 + s * gap) % PHASES
            unit = on if p2 > 0 else off
            part = p2 * (np.interp(t, np.arange(PHASES + 1), np.append(
                level, level[0])) - held) / unit
            slope = p2 * slopes[t.astype(int) % PHASES] * gap / unit
            if p1 == p2:
                name, guess = "SAME", (s, 1.0)
            elif p0 == p1:
                name, guess = "TURNED", parabola(
                    s, on if p1 > 0 else off, unit, max(t1 - t0, 1e-3) / gap)
            else:
                name, guess = "UNSURE", parabola(s, 1.0, 1.0, None)
            errors[name].append(np.stack([part - guess[0], slope - guess[1]]))
            # The same pixel while its next event is not known: nothing up to t + ahead.
            ahead = rng.uniform(0.1, 0.9)
            now = s * (1 - ahead)
            known = now + ahead
            t = (t1 + now * gap) % PHASES
            unit = on if p1 > 0 else off
            part = p1 * (np.interp(t, np.arange(PHASES + 1), np.append(
                level, level[0])) - held) / unit
            slope = p1 * slopes[t.astype(int) % PHASES] * gap * known / unit
            errors["QUIET"].append(np.stack([
                part - 2 * now / known * (1 - now / known),
                slope - (2 - 4 * now / known)]))
    out = {}
    for name, found_errors in errors.items():
        part, slope = np.moveaxis(np.array(found_errors), 1, 0)
        out[f"{name}_VARIANCE"] = robust(part)
        out[f"{name}_RATE_VARIANCE"] = robust(slope)
    return out


def lagging(depth: float, f0: float, k: float) -> tuple[np.ndarray, np.ndarray]:
    """Log intensity and what a pixel shows of it, y' = 2 pi (f0 + k I)(ln I - y)."""
    light = np.log1p(depth * np.cos(np.arange(PHASES) * 2 * np.pi / PHASES))
    gain = -np.expm1(-2 * np.pi / PHASES * (f0 + k * np.exp(light)))
    y, level = light[0], np.empty(PHASES)
    for _ in range(2):      # the second turn has forgotten where the first began
        for i in range(PHASES):
            level[i] = y = y + gain[i] * (light[i] - y)
    return light, level


def lead(change: np.ndarray, level: np.ndarray, f0: float, k: float) -> np.ndarray:
    """Solve u (f0 + k e^(level + u)) = change by bisection, -.85 <= u <= 2."""
    low, high = np.full_like(change, -0.85), np.full_like(change, 2.0)
    for _ in range(30):
        u = (low + high) / 2
        more = u * (f0 + k * np.exp(level + u)) < change
        low, high = np.where(more, u, low), np.where(more, high, u)
    return (low + high) / 2


def lost(draws: int = 200, seed: int = 3) -> tuple[float, float]:
    """Return where the line of errors over falls begins, and its slope."""
    rng = np.random.default_rng(seed)
    s = (np.arange(16) + 0.5) / 16
    found_all = []
    for _ in range(draws):
        corner = np.exp(rng.uniform(*np.log(LAGS["corner"])))
        f0 = corner * rng.uniform(*LAGS["constant"])
        k = corner - f0
        theta = rng.uniform(*PRIOR["theta"])
        ratio = np.exp(PRIOR["ratio_sigma"] / 2 * rng.standard_normal())
        on, off = theta * ratio, theta / ratio
        light, level = lagging(rng.uniform(*PRIOR["depth"]), f0, k)
        found = list(events(rng, level, on, off, noise=0.0))
        for (t0, p0, _), (t1, p1, held), (t2, p2, _) in zip(
                found[:-2], found[1:-1], found[2:], strict=True):
            if p1 != p2 and p0 != p1:
                continue
            before, gap = max(t1 - t0, 1e-3), max(t2 - t1, 1e-3)
            part, rate = (s, 1.0) if p1 == p2 else parabola(
                s, *((on, off) if p1 > 0 else (off, on)), before / gap)
            falls = p1 < 0      # in this gap, or in the one before the turn
            fall = off * PHASES / (gap if p1 == p2 else before) if falls else 0.0
            unit = on if p2 > 0 else -off
            y = held + unit * part
            u = lead(unit * rate * PHASES / gap / (2 * np.pi), y, f0, k)
            c = fall / (2 * np.pi) * k * np.exp(y) / (f0 + k * np.exp(y)) ** 2
            true = np.interp((t1 + s * gap) % PHASES, np.arange(PHASES + 1),
                             np.append(light, light[0]))
            found_all.append(np.stack([c, y + u - true]))
    c, error = np.concatenate(found_all, axis=1)
    rms = [np.sqrt(np.mean(error[(low <= c) & (c < high)] ** 2))
           for low, high in itertools.pairwise(FALLS)]
    slope, offset = np.polyfit((FALLS[:-1] + FALLS[1:]) / 2, rms, 1)
    return float(-offset / slope), float(slope)


def robust(errors: np.ndarray) -> float:
    """Variance of a normal distribution with the same middle two thirds."""
    return float(np.quantile(np.abs(errors), 0.6827) ** 2)


def study(quick: bool) -> list[Found]:
    """By what factor the variances that kernels state differ from what is measured.

    And where the error of a fast fall begins, and its slope, which scatter by a
    twentieth with the draws.
    """
    constants = stated()
    begins, slope = lost(80 if quick else 400)
    return [
        Found("_lag.pxd LOST_FROM", begins, constants["LOST_FROM"], 0.1),
        Found("_lag.pxd LOST_SLOPE", slope, constants["LOST_SLOPE"], 0.1),
        *(Found(f"{name} ({constants[name]:g}; {value:.2g} measured), factor",
              max(constants[name] / value, value / constants[name]), 4, at_least=True)
          for name, value in measured(60 if quick else 400).items())]


if __name__ == "__main__":
    raise SystemExit(main(study))
