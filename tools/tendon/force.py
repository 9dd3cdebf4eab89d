"""Bring a file of force or displacement on to the recording's clock."""
from __future__ import annotations

import argparse
import contextlib
import math
from dataclasses import replace

import numpy as np

from pdavis_cv import Recording, analysis

from .._common import UsageError
from .findings import Findings
from .results import loop_of

_WITHIN_S = 0.5     # default of --within
_FUSED_LAG = 0.03   # cycles; simulated, pixels that are slower than assumed


def align(
    args: argparse.Namespace, recording: Recording, found: Findings,
    load: analysis.LoadTrace,
) -> None:
    """Add the load's clock and its values at the images' times to the findings."""
    clock = _clock(args, recording, found, load)
    found.clock, found.load = clock, load
    t = found.fused.t_us
    seconds = clock.to_seconds(t)
    gone = load.inside_gap(seconds)
    if gone.all():
        raise UsageError(
            f"{args.load}: no sample falls on the recording; its clock may be another, "
            f"or its time in another unit (it spans {load.t_s[0]:g} .. "
            f"{load.t_s[-1]:g} s)")
    for name, values in (("force_n", load.force_n),
                         ("displacement_mm", load.displacement_mm)):
        if values is not None:
            found.extra[name] = np.where(
                gone, np.nan, np.interp(seconds, load.t_s, values))
    if gone.any():
        found.messages.append(
            f"load file: {np.count_nonzero(gone)} of {len(t)} images lie in its gaps "
            "or outside it")
    if clock.how == "trigger" and args.clock_offset_us is None and (
            found.frames is not None and recording.info.event_count != 0):
        found.messages.append(
            "load file: triggers are on the events' clock, phases on the frames', "
            "which in a DAVIS346 is 4 to 7 ms ahead: --clock-offset states by how much")
    if clock.how == "correlation":
        found.messages.append(
            "load file: aligned by correlation, which takes any lag of DoLP behind the "
            "load as an offset of the clocks: lag and hysteresis cannot be told; "
            "state --offset or record a trigger")
        return
    found.loops = [loop_of(found, i) for i in range(len(found.waves))]


def _clock(
    args: argparse.Namespace, recording: Recording, found: Findings,
    load: analysis.LoadTrace,
) -> analysis.Clock:
    """Align by what is known: triggers, a stated offset, and last by correlation."""
    pulses = np.empty(0, np.int64)
    if args.align == "trigger" or (args.align is None and load.trigger is not None):
        triggers = np.concatenate([packet.triggers for packet in recording.packets()])
        pulses = triggers["t"][np.isin(triggers["type"], (1, 3))]
        if args.align and not pulses.size:
            raise UsageError("--align trigger: the recording holds no external trigger")
    if pulses.size:
        return analysis.align_by_triggers(
            pulses, load.trigger_times(),
            resolution_s=float(np.median(np.diff(load.t_s)))
        ).counted_from(found.origin_us)
    if args.align == "offset" and args.offset is None:
        raise UsageError("--align offset needs --offset")
    if args.align == "offset" or (args.align is None and args.offset is not None
                                  and args.within is None):
        return analysis.Clock(found.origin_us, args.offset, skew_ppm=args.skew_ppm)
    return _correlated(args, found, load)


def _correlated(
    args: argparse.Namespace, found: Findings, load: analysis.LoadTrace
) -> analysis.Clock:
    """Align by the DoLP of frames, which have no lag, if it determines the offset.

    It does, unless frames are locked to the load's phase.  Aliasing is no problem, as
    the load is known between frames.
    """
    # Any region would do; the one that swings most, compared with its error, is best.
    best = int(np.argmax([0.0 if waves is None else (
        waves["dolp"].amplitude[0] / waves["dolp"].amplitude_se)
        for waves in found.waves]))
    within = _WITHIN_S if args.within is None else args.within

    def aligned(traces: analysis.Traces) -> analysis.Clock:
        shift = (int(traces.t_us[0]) - found.origin_us) / 1e6
        return analysis.align_by_correlation(
            traces.t_us, traces.table["dolp"][best], load, sign=args.load_sign,
            expected_s=None if args.offset is None else args.offset - shift,
            within_s=None if args.offset is None else within
        ).counted_from(found.origin_us)

    if found.frames is not None and found.light.fit.harmonics:
        with contextlib.suppress(ValueError):   # too few samples overlap
            return aligned(found.frames)
    found.messages.append(
        "load file: aligned with the fused images, which may lag by 3 % of a cycle, as "
        "the frames alone do not fix its offset")
    clock = aligned(found.fused)
    error = math.hypot(clock.offset_se_s, _FUSED_LAG / found.load_hz)
    return replace(clock, offset_se_s=error)
