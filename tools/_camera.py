"""What is known of a camera, for people."""
from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from pdavis_cv import Calibration
from pdavis_cv.recording.facts import CALIBRATION, MEASURED


def of_all_pixels(
    parts: Mapping[str, Any], known: Calibration | None = None,
) -> Iterator[tuple[str, str]]:
    """Yield what a camera's pixels have in common, with errors and origins.

    `parts` are named as the fields of a Calibration; what differs from those of
    `known` was measured.
    """
    parts = {**parts, **parts.get("learned", {})}

    def said(what: str, name: str, text: str) -> tuple[str, str]:
        told = None if known is None else known.learned.get(
            name, getattr(known, name, None))
        same = told is not None and np.array_equal(told, parts[name])
        return what, f"{text} ({CALIBRATION if same else MEASURED})"

    if "thresholds_sigma" in parts:
        on, off = (np.median(parts[name]) for name in ("theta_on", "theta_off"))
        yield said("thresholds", "theta_on", f"ON {on:.4f}, OFF {off:.4f} +- "
                   f"{100 * parts['thresholds_sigma']:.1f} %")
    if "bandwidth_sigma" in parts:
        hz, per_dn = (parts.get(name, 0) for name in (
            "bandwidth_hz", "bandwidth_hz_per_dn"))
        yield said("bandwidth", "bandwidth_sigma", f"{hz:.1f} Hz + {per_dn:.3g} Hz per "
                   f"DN/ms +- {100 * parts['bandwidth_sigma']:.0f} %")
    if "black_dn" in parts:
        yield said("black level", "black_dn", "{:.1f} +- {:.1f} DN".format(
            parts["black_dn"], parts.get("black_sigma_dn", 0)))
    if "clock_offset_us" in parts:
        us, sigma = parts["clock_offset_us"], parts.get("clock_offset_sigma_us", 0)
        yield said("clock offset", "clock_offset_us",
                   f"{us / 1000:+.2f} +- {sigma / 1000:.2f} ms")
