"""Two kinds of score on the same recordings: by frames left out, and by the truth."""
from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from lab.scoring import Scorer
from pdavis_cv.analysis import CLASSES, LeftOutFrames, PredictionScore
from pdavis_cv.batch.works import predicted_images
from pdavis_cv.simulation import Camera, RotatingPolarizer, Scene, Texture, Truth
from pdavis_cv.tools.score import Trial, trials

from .light import edges
from .page import table
from .run import OFF_LOCK, Settings

_SIZE = (16, 16)
_SECONDS = 2.0
_MOVING, _IN_CELL = CLASSES[0], CLASSES[-1]


@dataclasses.dataclass(frozen=True, kw_only=True)
class BothScores:
    """A method on a recording; natural-log units, degrees, and DoLP.

    ``frame_`` is from the frames left out, ``light_`` from the light at these times;
    ``moving`` pixels, and their ratios ``in_cell`` (see `LeftOutFrames`).
    """

    scene: str
    camera: str
    seed: int
    method: str
    pixels: int
    frame_moving: float
    light_moving: float
    frame_in_cell: float
    light_in_cell: float
    aop_error_deg: float
    dolp_error: float


def _scenes(settings: Settings, seed: int, start_deg: float) -> dict[str, Scene]:
    start = math.radians(start_deg)
    return {
        **{f"polarizer, {rpm:g} RPM": RotatingPolarizer(
            rpm=rpm * OFF_LOCK, start_angle=start, dolp=0.8)
           for rpm in settings.rpms or (30.0, 60.0, 200.0)},
        "texture, 200 pixels/s": Texture(seed=seed),
        "edges, 60 pixels/s": edges(60.0)}


def both_scores(settings: Settings) -> Iterator[BothScores]:
    """Simulate, leave frames out, and score every method both ways."""
    for preset, (seed, start_deg) in itertools.product(
            settings.cameras or ("nominal", "davis346"), settings.specimens):
        camera = Camera.preset(preset, seed=seed, size=_SIZE)
        for name, scene in _scenes(settings, seed, start_deg).items():
            recording, truth = camera.record(scene, settings.seconds or _SECONDS)
            left_out = LeftOutFrames(recording)
            for method, trial in trials().items():
                if not trial.usual:
                    continue
                yield BothScores(scene=name, camera=preset, seed=seed, method=method,
                                 **_scored(trial, left_out, camera, truth))


def _scored(
    trial: Trial, left_out: LeftOutFrames, camera: Camera, truth: Truth,
) -> dict[str, Any]:
    y, x = np.mgrid[:_SIZE[0], :_SIZE[1]]
    guesses, light = [], []
    scorer = Scorer(truth, (_SIZE[0] // 2, _SIZE[1] // 2))
    for image, estimate in predicted_images(left_out, **trial.options):
        scorer.add(image)
        guesses.append(estimate)
        stokes = np.stack(truth.stokes(image.t_us or 0, x, y), axis=-1)
        light.append(np.log(np.sum(camera.maps["analyser"] * stokes, axis=-1)))
    by_frames = _by_class(left_out.score(
        left_out.averaged(guesses), relative=trial.relative))
    samples = left_out.sample_times_us.shape[1]
    middle = slice(samples // 2, None, samples)
    by_light = _by_class(left_out.score(
        guesses[middle], relative=trial.relative, truth=light[middle]))
    score = scorer.score
    return {
        "pixels": by_frames[_IN_CELL].pixels,
        "frame_moving": by_frames[_MOVING].rmse,
        "light_moving": by_light[_MOVING].rmse,
        "frame_in_cell": by_frames[_IN_CELL].rmse,
        "light_in_cell": by_light[_IN_CELL].rmse,
        "aop_error_deg": math.degrees(score.aop_error),
        "dolp_error": score.dolp_error}


def _by_class(scores: Sequence[PredictionScore]) -> dict[str, PredictionScore]:
    return {score.kind: score for score in scores}


def both_scores_page(rows: Sequence[BothScores]) -> list[str]:
    """Return the Markdown: both scores side by side, and whether they agree."""
    lines = [
        "# score", "",
        "Every second frame of simulated recordings is left out and predicted, as "
        "`pdavis score` does. *Frame*: error against that frame, which is blurred and "
        "noisy; *light*: against the light itself at that time, of the same pixels. "
        "Root mean square, natural log: of pixels that move / of the ratios of their "
        "cells' channels. AoP (degrees) and DoLP: mean absolute error of super-pixels "
        "against the truth at these times. Mean over specimens.", ""]
    agreed, all_recordings, ranks = 0, 0, []
    for camera, scene in dict.fromkeys((row.camera, row.scene) for row in rows):
        mine = [row for row in rows if (row.camera, row.scene) == (camera, scene)]
        methods = list(dict.fromkeys(row.method for row in mine))
        lines += [f"## {scene}, `{camera}`", "", *table(
            ("method", "frame", "light", "AoP / DoLP"),
            [_line(name, [row for row in mine if row.method == name])
             for name in methods])]
        for seed in {row.seed for row in mine}:
            one = [row for row in mine if row.seed == seed]
            said = np.array([row.frame_in_cell for row in one])
            true = np.array([row.aop_error_deg for row in one])
            all_recordings += 1
            agreed += bool(true[np.argmin(said)] <= 1.1 * true.min())
            ranks.append(float(spearmanr(said, true).statistic))
    lines += ["## Do they agree?", "",
              f"In {agreed} of {all_recordings} recordings the method that frames left "
              "out say has the least error of a cell's ratios has an AoP error at most "
              "10 % above the least. The rank correlation of both over the methods is "
              f"{np.mean(ranks):.2f} (least {np.min(ranks):.2f}).", ""]
    return lines


def _line(name: str, rows: Sequence[BothScores]) -> list[str]:
    def text(first: str, second: str, digits: tuple[int, int]) -> str:
        values = [np.mean([getattr(row, column) for row in rows])
                  for column in (first, second)]
        return " / ".join("-" if math.isnan(value) else f"{value:.{n}f}"
                          for value, n in zip(values, digits, strict=True))

    return [name, text("frame_moving", "frame_in_cell", (3, 3)),
            text("light_moving", "light_in_cell", (3, 3)),
            text("aop_error_deg", "dolp_error", (2, 3))]
