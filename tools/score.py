"""Score methods on a recording by predicting left-out frames.

Every second frame is left out, first the odd and then the even ones.  Each method
predicts the mean light of its exposure from the rest, and is compared with the frame:
root mean squared error in natural-log units (0.1 is 10 %), for pixels that move (at
least 3 events within 40 ms) and for others, and the fraction of errors within one sigma
(0.68 if sigmas are correct).  Where 2x2 cells move, the error of the ratios of their
pixels, which determine the polarization, is reported as well.  No ground truth is
needed.
"""
from __future__ import annotations

import argparse
import dataclasses
import functools
import inspect
import json
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pdavis_cv import Calibration, Recording, __version__
from pdavis_cv._beside import all_or_none
from pdavis_cv.analysis import CLASSES, LeftOutFrames, PredictionScore, pooled
from pdavis_cv.batch import both_halves, predicted
from pdavis_cv.errors import PdavisWarning
from pdavis_cv.export import write_csv, write_json
from pdavis_cv.fusion import Fusion
from pdavis_cv.reconstruct.methods import METHODS, make_reconstructor
from pdavis_cv.recording.base import start_of
from pdavis_cv.sensor import NOMINAL_THRESHOLDS

from ._camera import of_all_pixels
from ._common import Parser, UsageError, checked_out, command
from ._options import add_file, add_source_options, calibration_of, opened
from ._progress import progress
from ._values import pair, positive

_CELLS = CLASSES[-1]

SOURCES = ("default", "nominal", "in-situ")
_LEAST_MOVING = 100   # pixels: with fewer, static pixels decide
_ALLOWED_STATIC = 1.2  # largest static error of a chosen method, over the least one


@dataclass(frozen=True)
class Trial:
    """A variant of a method that is scored, with these options of `fuse`.

    It is `relative` if it estimates only ratios of a cell's channels, and so needs
    polarizers, `causal` if it uses no later data, `usual` if it is scored unasked;
    `thresholds` tells whether it takes contrast thresholds.
    """

    options: Mapping[str, Any]
    relative: bool = False
    causal: bool = False
    thresholds: bool = True
    usual: bool = True


def trials() -> dict[str, Trial]:
    """Return what can be scored, by name: each method's variants, also causal ones."""
    found: dict[str, Trial] = {}
    for method, maker in METHODS.usable().items():
        probe = functools.partial(make_reconstructor, maker, (2, 2), 0.2, 0.2)
        try:
            said = probe({}).trials
        except ImportError:     # a package that the method needs is missing
            continue
        except Exception as error:  # of another package's method
            warnings.warn(f"method {method!r} is not scored: {error}", PdavisWarning,
                          stacklevel=2)
            continue
        for name, parameters in (said or {method: {}}).items():
            made = probe(parameters)
            trial = found[name] = Trial(
                {"method": method, **parameters}, relative=not made.needs.frames,
                causal=not made.needs.events, usual=said != {},
                thresholds="theta_on" in inspect.signature(maker).parameters)
            if made.needs.events and probe(
                    {**made.causal_parameters, **parameters}).lookahead_us == 0:
                found[f"{name} causal"] = dataclasses.replace(
                    trial, options={**trial.options, "causal": True}, causal=True)
    return found


@dataclass(frozen=True)
class Row:
    """A method, the origin of its thresholds, and its scores by class.

    It has no `trial` if `fuse` does not make its images.
    """

    method: str
    source: str
    thresholds: tuple[float, float] | None
    scores: tuple[PredictionScore, ...]
    trial: Trial | None = None

    @property
    def causal(self) -> bool:
        """Whether the method uses no later data."""
        return self.method.startswith("held") if self.trial is None else (
            self.trial.causal)

    @property
    def by_class(self) -> dict[str, PredictionScore]:
        """The score of each class."""
        return {score.kind: score for score in self.scores}

    @property
    def name(self) -> str:
        """Text with the method and its thresholds."""
        return f"{self.method}, {self.source}" if self.source else self.method


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pdavis score``."""
    known = trials()
    args = _parser(known).parse_args(argv)
    if args.out is not None:
        checked_out(args.out)
    calibration = None if args.calibration is None else calibration_of(args.calibration)
    with opened(args) as recording:
        halves = both_halves(recording, start_of(recording) + round(args.seconds * 1e6))
        camera = Fusion(halves[0].kept, calibration=calibration).camera
        told = {name: float(np.median(value)) for name in camera.parts
                if name not in ("layout", "model") for value in (
                    camera.learned.get(name, getattr(camera, name, None)),)}
        tries = _tries(args.thresholds, calibration)
        rows = [_pooled(pair) for pair in zip(*([
            Row(name, "", None, one.score(guesses))
            for name, guesses in one.simple().items()] for one in halves), strict=True)]
        asked = [(name, *each) for name in _possible(known, args.methods, recording)
                 for each in (tries if known[name].thresholds else [("", {})])]
        for name, source, options in progress(asked, len(asked), "methods"):
            rows.append(_pooled([_predicted(one, name, known[name], source, options)
                                 for one in halves]))
        polarized = recording.info.layout is not None
    advice = _advice(rows, args.file, polarized=polarized)
    summary = {**_summary(args, halves, rows, advice), "camera": told}
    if args.json:
        print(json.dumps(summary, indent=2))
    else:
        print("\n".join([*_table(halves, rows), "", *(
            f"{what}: {text}" for what, text in of_all_pixels(told, calibration)),
            "", *advice]))
    if args.out is not None:
        _write(args.out, rows, summary)
    return 0


def _predicted(
    left_out: LeftOutFrames, name: str, trial: Trial, source: str,
    options: Mapping[str, Any],
) -> Row:
    """Return the row of a method on one half of the frames."""
    stated = NOMINAL_THRESHOLDS if source == "nominal" else options.get("thresholds")
    return Row(name, source, None if isinstance(stated, str) else stated,
               left_out.score(predicted(left_out, **trial.options, **options),
                              relative=trial.relative), trial)


def _pooled(rows: Sequence[Row]) -> Row:
    """Return the row of all frames."""
    return dataclasses.replace(rows[0], scores=pooled(row.scores for row in rows))


def _parser(known: Mapping[str, Trial]) -> argparse.ArgumentParser:
    parser = Parser("score", __doc__ or "", "pdavis score run.aedat4 -o score")
    add = parser.add_argument
    slow = [name for name, one in known.items() if not one.usual]
    add_file(parser, "a recording with frames and events")
    add("-o", "--out", type=Path, metavar="STEM", help="write STEM.csv and STEM.json")
    add("--methods", nargs="+", choices=known, metavar="NAME", help="methods from "
        f"{', '.join(map(repr, known))}; causal: only from data that had arrived, as "
        f"live; default: all that the recording supports, but {', '.join(slow)}")
    add("--thresholds", nargs="+", type=_source, default=["default", "in-situ"],
        metavar="T", help=f"thresholds from {', '.join(SOURCES)}, or ON,OFF in "
        "natural-log units; default: default in-situ")
    add("--calibration", type=Path, metavar="NPZ",
        help="calibration of this camera, whose thresholds are tried too")
    add("--seconds", type=positive, default=10.0,
        help="length of the recording's beginning that is scored; default 10")
    add_source_options(parser)
    add("--json", action="store_true", help="print JSON instead of the table")
    return parser


def _possible(
    known: Mapping[str, Trial], methods: Sequence[str] | None, recording: Recording,
) -> list[str]:
    """Return the requested methods, or all usual ones that the recording supports."""
    plain = recording.info.layout is None
    for name in methods or ():
        if plain and known[name].relative:
            raise UsageError(f"{name!r} needs polarizers: give --layout")
    return list(methods or (name for name, one in known.items()
                            if one.usual and not (plain and one.relative)))


def _source(text: str) -> str | tuple[float, float]:
    return text if text in SOURCES else pair(text)


def _tries(
    sources: Sequence[str | tuple[float, float]], calibration: Calibration | None,
) -> list[tuple[str, dict[str, Any]]]:
    """Return the origins of thresholds to try, each with the options of fuse."""
    tries = [(one if isinstance(one, str) else "given", {
        "thresholds": None if one == "default" else one, "calibration": calibration})
        for one in sources]
    if calibration is not None and calibration.theta_on is not None:
        tries.append(("calibration", {
            "thresholds": "calibration", "calibration": calibration}))
    return tries


def suited(rows: Sequence[Row], *, causal: bool = False) -> Row:
    """Return the row of the best method for the recording.

    It has the smallest error for moving pixels, among methods that are not much worse
    than the best one for static pixels.  If too little moves, it has the smallest error
    for static pixels.  With `causal`, only methods that use no later data count.
    """
    able = [row for row in rows if (row.trial is None or not row.trial.relative)
            and (not causal or row.causal)]

    def static(row: Row) -> float:
        each = row.by_class
        parts = [each[kind] for kind in CLASSES if kind.startswith("static")]
        squares = sum(part.rmse**2 * part.pixels for part in parts if part.pixels)
        return float(np.sqrt(squares / max(1, sum(part.pixels for part in parts))))

    if able[0].by_class["moving"].pixels < _LEAST_MOVING:
        return min(able, key=static)
    least = min(map(static, able))
    steady = [row for row in able if static(row) <= _ALLOWED_STATIC * least]
    return min(steady, key=lambda row: row.by_class["moving"].rmse)


def suited_for_polarization(rows: Sequence[Row], *, causal: bool = False) -> Row:
    """Return the row with the smallest error of the channels' ratios in moving cells.

    With `causal`, only methods that use no later data count.
    """
    return min((row for row in rows if not causal or row.causal),
               key=lambda row: row.by_class[_CELLS].rmse)


def _advice(rows: Sequence[Row], file: str, *, polarized: bool) -> list[str]:
    lines = []
    enough = rows[0].by_class[_CELLS].pixels >= _LEAST_MOVING
    for title, causal in (("recorded", False), ("live", True)):
        able = [row for row in rows if row.trial and not row.trial.relative]
        if not able or (causal and not any(row.causal for row in able)):
            continue
        row = suited(rows, causal=causal)
        score = row.by_class["moving"]
        lines.append(f"{title}: {row.name} suits it best ({score.rmse:.3f} where "
                     "pixels move)")
        lines += _command(row, file)
        if math.isfinite(score.coverage) and not 0.55 <= score.coverage <= 0.8:
            lines.append(
                f"  its sigmas are too {'small' if score.coverage < 0.68 else 'large'}:"
                f" {score.coverage:.0%} of errors where pixels move lie within one")
        if polarized and enough:
            row = suited_for_polarization(rows, causal=causal)
            lines.append(f"{title}, for polarization: {row.name} is least off in the "
                         f"ratios of a cell ({row.by_class[_CELLS].rmse:.3f})")
            lines += _command(row, file)
    return lines


def _command(row: Row, file: str) -> list[str]:
    """Return the line that makes images with a method, if `fuse` does."""
    if row.trial is None:
        return []
    words = []
    for name, value in row.trial.options.items():
        words.append(f"--method {value}" if name == "method"
                     else "--causal" if name == "causal" else f"--set {name}={value}")
    if row.source == "calibration":
        words.append("--calibration FILE --thresholds calibration")
    elif row.source in ("nominal", "in-situ"):
        words.append(f"--thresholds {row.source}")
    elif row.thresholds is not None:
        words.append("--thresholds {:.3f},{:.3f}".format(*row.thresholds))
    return [f"  pdavis export {file} -o fused.mp4 {' '.join(words)}"]


def _table(halves: Sequence[LeftOutFrames], rows: Sequence[Row]) -> list[str]:
    width = max(len(row.name) for row in rows)
    lines = [f"{_count(halves)} frames left out", "",
             f"{'error, part within one sigma':<{width}}  "
             + "".join(f"{kind:>16}" for kind in CLASSES)]
    for row in rows:
        cells = [("-    " if math.isnan(score.rmse) else f"{score.rmse:.3f}") + (
            f"{score.coverage:6.2f}" if math.isfinite(score.coverage) else " " * 6)
            for score in row.scores]
        lines.append(f"{row.name:<{width}}  " + "".join(f"{cell:>16}"
                                                        for cell in cells))
    lines.append(f"{'pixels':<{width}}  " + "".join(
        f"{score.pixels:>10}{'':6}" for score in rows[0].scores))
    return lines


def _summary(
    args: argparse.Namespace, halves: Sequence[LeftOutFrames], rows: Sequence[Row],
    advice: Sequence[str],
) -> dict[str, Any]:
    def plain(value: Any) -> Any:
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return {
        "pdavis_cv": __version__, "source": str(args.file),
        "frames_left_out": _count(halves),
        "advice": list(advice),
        "rows": [{"method": row.method, "thresholds_from": row.source,
                  "thresholds": row.thresholds,
                  "scores": {score.kind: {
                      name: plain(value)
                      for name, value in dataclasses.asdict(score).items()
                      if name != "kind"} for score in row.scores}} for row in rows]}


def _count(halves: Sequence[LeftOutFrames]) -> int:
    return sum(len(one.times_us) for one in halves)


@all_or_none()
def _write(stem: Path, rows: Sequence[Row], summary: Mapping[str, Any]) -> None:
    write_csv(
        stem.with_name(stem.name + ".csv"),
        ("method", "thresholds_from", "on", "off", "class", "pixels", "rmse_ln",
         "bias_ln", "coverage"),
        ((row.method, row.source, *(row.thresholds or ("", "")), score.kind,
          score.pixels, score.rmse, score.bias, score.coverage)
         for row in rows for score in row.scores))
    write_json(stem.with_name(stem.name + ".json"), summary)
