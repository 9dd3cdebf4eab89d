"""Figures 2 and 3: the networks, on events alone, at the ends of their windows."""
from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from pdavis_cv.fusion import fuse
from pdavis_cv.reconstruct.weights import Weights

from . import network
from .rotation import Comparison, Rotation, Trace, mean_traces
from .run import (
    METHODS,
    NETWORKS,
    SETTLE_US,
    TAIL_US,
    Case,
    Settings,
    Take,
    row_of,
    score,
)

_SCORED_US = 400_000
_TRACE_CYCLES = 2.2
# The light of all scenes repeats with half a turn: a trace may begin that much later.
_REPEATS_PER_TURN = 2


def network_case(case: Case, rotation: Rotation) -> network.NetworkCase:
    """Return the recording that a network needs of a case.

    It sees 40 x 40 pixels, of which the middle 12 x 12 count as in the paper, and is
    given the time in which its memory settles.

    Parameters
    ----------
    case : Case
        What other methods are scored on.
    rotation : Rotation
        Scene of the case.

    Returns
    -------
    NetworkCase
    """
    period = case.turn_us / rotation.cycles
    settled = max(SETTLE_US, network.SETTLING * network.window_us(period))
    traced = case.turn_us / _REPEATS_PER_TURN + _TRACE_CYCLES * period
    return network.NetworkCase(
        case=dataclasses.replace(
            case, size=(network.SIDE, network.SIDE), regions=network.middle_of,
            seconds=(settled + max(_SCORED_US, traced) + TAIL_US) / 1e6),
        setting=f"{case.rpm:g} RPM", period_us=period)


def add_networks(
    result: Comparison, settings: Settings, made: Sequence[Case],
    weights: Mapping[str, Weights], tick: Callable[[], object],
) -> None:
    """Add the networks' rows, and traces at the lowest and the highest speed.

    Parameters
    ----------
    result : Comparison
        Of `compare`.
    settings : Settings
    made : sequence of Case
        Those of the comparison.
    weights : mapping of str to Weights
        By network.
    tick : callable
        Called after each case.
    """
    names = [name for name in NETWORKS if name in settings.methods]
    if not names:
        return
    missing = {(trace.rpm, name) for trace in result.traces for name in names}
    for case in made:
        seen = network_case(case, result.rotation)
        window = network.window_us(seen.period_us)
        camera = seen.case.specimen(METHODS["frames"])
        recording, truth = camera.record(
            case.light(case.event_dn_per_ms), seen.case.seconds)
        take = Take(recording, truth, 0, truth.stop_us)
        for name in names:
            parameters = network.parameters_of(name, seen.case, window, weights)
            times = network.window_ends(take, window)
            found = score(take, regions=network.middle_of(camera), times_us=times,
                          **parameters)["middle"]
            result.rows.append(row_of(
                case, name, found, region="all", camera=case.camera))
            if (case.rpm, name) in missing:
                missing.remove((case.rpm, name))
                result.traces.append(_trace(seen, name, take, window, parameters))
        tick()


def _trace(made: network.NetworkCase, name: str, take: Take, window: int,
           parameters: Mapping[str, Any]) -> Trace:
    """Return AoP and DoLP of the middle, in the time of the other methods' traces."""
    repeat = made.case.turn_us / _REPEATS_PER_TURN
    settled = max(SETTLE_US, network.SETTLING * window)
    later = math.ceil((settled - SETTLE_US) / repeat) * repeat
    first, last = SETTLE_US + later, SETTLE_US + later + _TRACE_CYCLES * made.period_us
    times = np.arange(-(-first // window), last // window + 1).astype(np.int64) * window
    where = network.middle_of(made.case.specimen(METHODS["frames"]))["middle"]
    aop, dolp = mean_traces(
        fuse(take.recording, times_us=times, demosaic="superpixel", **parameters),
        where)
    return Trace(made.case.rpm, name, times - round(later), aop, dolp)
