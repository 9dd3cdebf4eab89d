"""Populations of cameras: the distributions of a specimen's parameters.

The estimators are scored on cameras that do not follow their priors
(docs/theory/priors.md): the ranges here are wider, and centred elsewhere.  The seed of
a camera draws one value from each.
"""
from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from pdavis_cv.simulation import noise


class Range(NamedTuple):
    """A parameter's values over specimens: uniform in its log, or in itself.

    Uniform in the log, the median is the geometric mean of the ends.  `times` is the
    name of a parameter of the same part that the drawn value multiplies.
    """

    low: float
    high: float
    log: bool = True
    times: str = ""

    def at(self, u: float) -> float:
        """Return the value of quantile u, 0..1."""
        if self.log:
            return self.low * math.exp(u * math.log(self.high / self.low))
        return self.low + (self.high - self.low) * u


_DEGREES = math.radians(1.0)

_DRAWN: Mapping[str, Mapping[str, Range]] = {
    "dvs": {
        # 0.14: smallest of the paper (table S1); .29 and .37: fits to a DAVIS346.
        "theta_on": Range(0.14, 0.42),
        "theta_off": Range(0.85, 1.45, times="theta_on"),
        # Relative: 2.1 % of contrast (Lichtsteiner 2008) to v2e's .03 of .2.
        "mismatch": Range(0.02, 0.16),
        "cutoff_hz": Range(60.0, 600.0),
        "cutoff_hz_per_dn_ms": Range(0.5, 8.0),
        "refractory_us": Range(20.0, 1000.0),
        # 0.1 Hz at room temperature (Nozaki 2017); 0.7 Hz at 26 DN/ms (table S1).
        "leak_hz": Range(0.05, 1.0),
        "leak_sigma": Range(0.1, 0.3),
        "leak_hz_per_dn_ms": Range(0.001, 0.027),
        "shot_noise_hz": Range(0.2, 5.0),
    },
    "aps": {
        # FPN .5 % of the signal range (Brandli 2014) is 3.8 DN of 760.
        "offset_fpn_dn": Range(1.5, 8.0),
        "read_noise_dn": Range(1.0, 4.0),
        "electrons_per_dn": Range(20.0, 160.0),
        "dark_dn_s": Range(5.0, 100.0),
    },
    "optics": {
        "extinction_ratio": Range(22.0, 60.0),
        "extinction_ratio_sigma": Range(2.0, 5.0),
        "angle_sigma": Range(0.4 * _DEGREES, 2.5 * _DEGREES),
        "angle_smooth": Range(0.1 * _DEGREES, 1.5 * _DEGREES),
        "gain_sigma": Range(0.01, 0.06),
        "gain_smooth": Range(0.02, 0.2),
    },
}

_DAVIS346: Mapping[str, Mapping[str, Range]] = {
    "dvs": {
        # Fitted to two cameras at usual biases: .29 ON, .32 and .37 OFF.
        "theta_on": Range(0.26, 0.33),
        "theta_off": Range(1.05, 1.30, times="theta_on"),
        "mismatch": Range(0.03, 0.10),
        "cutoff_hz": Range(120.0, 400.0),
        "cutoff_hz_per_dn_ms": Range(0.5, 4.0),
        "refractory_us": Range(100.0, 700.0),
        "leak_hz": Range(0.05, 0.3),
        "leak_hz_per_dn_ms": Range(0.003, 0.027),
        "shot_noise_hz": Range(0.5, 3.0),
    },
    "aps": {
        "offset_fpn_dn": Range(2.5, 6.0),
        "read_noise_dn": Range(1.5, 3.5),
        "electrons_per_dn": Range(40.0, 120.0),
        "dark_dn_s": Range(10.0, 100.0),
    },
    # Measured on two cameras: events trail frames by 4 to 7.4 ms.
    "faults": {"frame_offset_us": Range(-7400.0, -4000.0, log=False)},
    # 40 at 500 nm, less at other wavelengths (the paper's measurement).
    "optics": {
        "extinction_ratio": Range(25.0, 44.0),
        "angle_sigma": Range(0.5 * _DEGREES, 1.5 * _DEGREES),
        "angle_smooth": Range(0.1 * _DEGREES, 1.0 * _DEGREES),
        "gain_sigma": Range(0.01, 0.045),
        "gain_smooth": Range(0.02, 0.15),
    },
}

# One camera, whose thresholds are not those that are stated.
_TYPICAL: Mapping[str, Mapping[str, Range]] = {
    "dvs": {"theta_on": Range(0.22, 0.22), "theta_off": Range(0.26, 0.26)}}

POPULATIONS: Mapping[str, Mapping[str, Mapping[str, Range]]] = MappingProxyType({
    "typical": _TYPICAL, "drawn": _DRAWN, "davis346": _DAVIS346})
"""Ranges by preset, part and parameter; the other presets are single cameras."""


def drawn(name: str, parts: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """Return a preset's parts with the parameters drawn for the specimen of a seed.

    A preset without a population stays as it is.
    """
    out = dict(parts)
    for part, ranges in POPULATIONS.get(name, {}).items():
        values: dict[str, Any] = {}
        for parameter, limits in ranges.items():
            u = float(noise.uniform(seed, f"{name} {part} {parameter}", [0])[0])
            value = limits.at(u)
            if limits.times:
                value *= values[limits.times]
            kind = type(getattr(out[part], parameter))
            values[parameter] = round(value) if kind is int else value
        out[part] = dataclasses.replace(out[part], **values)
    return out
