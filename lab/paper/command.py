"""python -m lab.paper: the paper's figures, from simulated cameras.

Every method against the light in front of the camera as truth: a table (CSV), a page
with the paper's words beside the figures (Markdown) and pictures (PNG, SVG, PDF).
"""
from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from pdavis_cv import __version__
from pdavis_cv.export import write_csv
from pdavis_cv.reconstruct.weights import Weights
from pdavis_cv.simulation import PRESETS
from pdavis_cv.tools._common import (
    Parser,
    UsageError,
    add_json_option,
    can_draw,
    checked_out,
    command,
    for_people,
    tell,
)
from pdavis_cv.tools._options import calibration_of
from pdavis_cv.tools._progress import progress
from pdavis_cv.tools._values import (
    LAST_SEED,
    layout_option,
    number,
    numbers,
    positive,
    roi_option,
    within,
)

from . import (
    both_scores,
    correct_span,
    demosaic,
    denoise,
    fan_images,
    light,
    network,
    optics_bench,
    overview,
    rotation,
    rotation_networks,
    rotation_page,
    specification,
    tendon_images,
    together,
    transfer,
    videos,
)
from .index import write_html, write_index
from .page import summary, write_page, write_rows
from .print_style import beside_stem, journal, save_figure
from .recording import fit_files, fits_page
from .run import METHODS, Case, Row, Settings, Takes, run

PAPER = ("fig2", "fig3", "fig4a", "dr", "flicker")
"""The experiments of the paper."""

EVENT_CAMERAS = tuple(name for name in PRESETS if PRESETS[name]["dvs"] is not None)

_NONE: Mapping[str, Any] = MappingProxyType({})

Result = tuple[str, list[Row]]


def _rotation(figure: str, stem: Path, settings: Settings) -> Result:
    """Figures 2 and 3."""
    scenes = rotation.SCENES[figure]
    made = [rotation.cases(scene, settings) for scene in scenes]
    return _compared(figure, stem, settings, scenes, made, None,
                     network.all_weights(settings.weights))


def _recorded(stem: Path, settings: Settings, args: argparse.Namespace) -> Result:
    """Figure 2 from recordings."""
    fitted = fit_files(
        args.recording, layout=args.layout, roi=args.roi,
        seconds=settings.seconds or 10.0, nominal=args.nominal,
        calibration=args.calibration and calibration_of(args.calibration))
    made = [each.case for each in sorted(fitted, key=lambda each: each.case.rpm)]
    return _compared("fig2", stem, settings, rotation.SCENES["fig2"], [made],
                     fits_page(fitted, args.roi))


def _compared(
    figure: str, stem: Path, settings: Settings, scenes: Sequence[rotation.Rotation],
    made: Sequence[Sequence[Case]], head: Sequence[str] | None,
    weights: Mapping[str, Weights] = _NONE,
) -> Result:
    count = (2 if weights else 1) * sum(map(len, made))
    shown = iter(progress(range(count), count, "cases"))
    next(shown)
    results = []
    for scene, each in zip(scenes, made, strict=True):
        result = rotation.compare(scene, settings, each, lambda: next(shown, None))
        if weights:
            rotation_networks.add_networks(
                result, settings, each, weights, lambda: next(shown, None))
        results.append(result)
    rows = [row for result in results for row in result.rows]
    write_rows(stem, rows, _facts(figure, settings))
    write_csv(
        beside_stem(stem, "-traces.csv"),
        ("scene", "rpm", "method", "t_us", "aop_deg", "dolp"),
        ((result.rotation.name, trace.rpm, trace.method, int(t), np.rad2deg(a), d)
         for result in results for trace in result.traces
         for t, a, d in zip(trace.t_us, trace.aop, trace.dolp, strict=True)))
    write_csv(
        beside_stem(stem, "-intervals.csv"),
        ("scene", "rpm", "from_us", "to_us", "events"),
        ((result.rotation.name, spectrum.rpm, low, high, int(count))
         for result in results for spectrum in result.spectra
         for low, high, count in zip(
             rotation.INTERVALS_US, rotation.INTERVALS_US[1:], spectrum.intervals,
             strict=False)))
    if can_draw():
        plots = _plots()
        for result in results:
            ending = "" if len(results) == 1 else (
                "-" + result.rotation.name.replace(" ", "-"))
            save_figure(
                beside_stem(stem, ending), plots.rotation_figure(figure, result))
            if result.traces:
                save_figure(beside_stem(stem, f"{ending}-traces"),
                            plots.traces_figure(result))
    return write_page(stem, rotation_page.page(figure, results, settings, head)), rows


def _written(
    figure: str, stem: Path, settings: Settings, kind: type, rows: Iterable[Any],
    page: Callable[[list[Any]], list[str]],
    draw: Callable[[list[Any]], Any] | None = None, facts: Mapping[str, Any] = _NONE,
) -> Result:
    """Write a table of dataclasses of one kind, a page of it and a picture."""
    found = list(rows)
    write_rows(stem, found, {**_facts(figure, settings), **facts}, kind)
    if found and draw is not None and can_draw():
        save_figure(stem, draw(found))
    return write_page(stem, page(found)), found if kind is Row else []


def _table(
    kind: type, rows: Callable[[Settings], Iterable[Any]],
    page: Callable[[list[Any]], list[str]],
    draw: Callable[[list[Any]], Any] | None = None,
) -> Experiment:
    """Return what makes the rows of one kind and writes them."""
    return lambda figure, stem, settings: _written(
        figure, stem, settings, kind, rows(settings), page, draw)


def _range(figure: str, stem: Path, settings: Settings) -> Result:
    """Figure 4a, the dynamic range, flicker: cases, a page and a picture."""
    make, describe = _RANGES[figure]
    made = make(settings)
    return _written(
        figure, stem, settings, Row,
        (row for case in progress(made, len(made), "cases")
         for row in run(case, settings, Takes(case))),
        lambda rows: describe(rows, settings),
        lambda rows: _plots().range_figure(figure, rows))


def _networks(figure: str, stem: Path, settings: Settings) -> Result:
    """Networks beside the other methods."""
    weights = network.all_weights(settings.weights)
    made = network.network_cases(settings)
    return _written(
        figure, stem, settings, network.NetworkRow,
        (row for case in progress(made, len(made), "cases")
         for row in network.measure(case, settings, weights)),
        lambda rows: network.network_page(rows, weights, network.step_costs(
            network.network_steps(weights), 2 if settings.quick else 20),
            settings.seeds), network.network_figure,
        {f"{name} weights": w.digest for name, w in weights.items()})


def _denoising(figure: str, stem: Path, settings: Settings) -> Result:
    """Noise that denoising leaves, and true events that it keeps."""
    return _written(
        figure, stem, settings, denoise.Denoised, denoise.denoise_cases(settings),
        denoise.denoise_page,
        lambda rows: denoise.denoise_figure(rows, denoise.example(settings)))


def _demosaicing(figure: str, stem: Path, settings: Settings) -> Result:
    """Demosaicing methods against whole images."""
    return _written(
        figure, stem, settings, demosaic.Score, demosaic.demosaic_cases(settings),
        demosaic.demosaic_page, lambda rows: demosaic.demosaic_figure(settings))


def _tables(figure: str, stem: Path, settings: Settings) -> Result:
    """Tables S1 and S2."""
    camera = (settings.cameras or ("nominal",))[0]
    compared = list(specification.ways(settings))
    write_rows(stem, compared, _facts(figure, settings), specification.Way, "-methods")
    return _written(
        figure, stem, settings, specification.Quantity,
        specification.specification(settings),
        lambda found: specification.specification_page(camera, found, compared))


def _fan_images(figure: str, stem: Path, settings: Settings) -> Result:
    """Figure 4a: what each method shows of the fan."""
    count = fan_images.count(settings)
    views = list(progress(fan_images.fan_views(settings), count, "images"))
    write_csv(beside_stem(stem, ".csv"), fan_images.PROFILE_COLUMNS,
              fan_images.profile_rows(views), _facts(figure, settings))
    if can_draw():
        save_figure(stem, fan_images.views_figure(views))
        save_figure(beside_stem(stem, "-profile"), fan_images.profiles_figure(views))
        stated = fan_images.uncertainty_figure(views)
        if stated is not None:
            save_figure(beside_stem(stem, "-uncertainty"), stated)
    return write_page(stem, fan_images.fan_images_page(views)), []


def _videos(figure: str, stem: Path, settings: Settings) -> Result:
    """Supplementary Videos 1 to 5."""
    facts, errors, sizes = _facts(figure, settings), {}, {}
    for name in progress(videos.VIDEOS, len(videos.VIDEOS), "videos"):
        path = beside_stem(stem, f"-{name}.webm")
        errors[name] = videos.write_video(path, name, settings, facts)
        sizes[name] = path.stat().st_size
    write_csv(beside_stem(stem, ".csv"), videos.COLUMNS,
              ((name, *row) for name, rows in errors.items() for row in rows), facts)
    page = videos.videos_page(stem.name, errors, sizes)
    write_html(stem, page)
    return write_page(stem, page), []


def _overview(figure: str, stem: Path, settings: Settings) -> Result:
    """Figure 1."""
    step, cloud = overview.step_response(), overview.aop_cloud(settings)
    frame, counts, views = overview.network_views(settings)
    write_csv(beside_stem(stem, ".csv"), overview.CLOUD_COLUMNS,
              overview.cloud_rows(cloud), _facts(figure, settings))
    if can_draw():
        save_figure(stem, overview.overview_figure(step, cloud))
        save_figure(beside_stem(stem, "-networks"),
                    overview.views_figure(frame, counts, views))
    return write_page(stem, overview.overview_page(step, cloud, views)), []


def _tendon(figure: str, stem: Path, settings: Settings) -> Result:
    """Figure 4b: traces, spectra and lock-in maps of a tendon."""
    count = tendon_images.count(settings)
    made = list(progress(tendon_images.pulls(settings), count, "traces"))
    write_csv(beside_stem(stem, ".csv"), tendon_images.COLUMNS,
              tendon_images.pull_rows(made), _facts(figure, settings))
    if can_draw():
        save_figure(stem, tendon_images.tendon_figure(made))
    return write_page(stem, tendon_images.tendon_page(made)), []


_RANGES: dict[str, tuple[Callable[[Settings], list[Case]],
                         Callable[[Sequence[Row], Settings], list[str]]]] = {
    "fig4a": (light.fan_cases, light.fan_page),
    "dr": (light.dynamic_range_cases, light.dynamic_range_page),
    "flicker": (light.flicker_cases, light.flicker_page),
}


_IN_ALL = ("fig1", *PAPER, "range", "fan", "tendon", "optics", "transfer", "denoise",
           "network", "tables", "videos")


# Of figures 2 and 3 ten specimens, each at its own start angle, make up for fewer
# images of each: 380 of a recording, at 5.077 ms.
_MANY = tuple(range(1, 11))
_STEPS_US = 1013, 5077  # no frame clock divides them


def _own(name: str, settings: Settings) -> Settings:
    """Fill in what was left to a figure: specimens, start angles, interval.

    Settings of all figures are left as they are: each fills in its own.
    """
    if name == "all":
        return settings
    seeds: tuple[int, ...] = (1,)
    steps, starts = _STEPS_US, Settings.starts_deg
    if name in rotation.SCENES:
        starts = ()
        if not settings.quick:
            seeds, steps = _MANY, _STEPS_US[1:] * 2
    return dataclasses.replace(
        settings, seeds=settings.seeds or seeds,
        starts_deg=settings.starts_deg or starts,
        step_us=settings.step_us or steps[settings.quick])


def _experiment(name: str, stem: Path, settings: Settings) -> Result:
    return EXPERIMENTS[name][1](name, stem, _own(name, settings))


def _all(figure: str, stem: Path, settings: Settings) -> Result:
    """Make everything, a table of it, and a page with the pictures."""
    stems = {name: beside_stem(stem, f"-{name}") for name in _IN_ALL}
    rows = together.made(stems, settings, _experiment)
    every = [row for each in rows.values() for row in each]
    write_rows(stem, every, _facts(figure, settings))
    write_index(stem, [(name, EXPERIMENTS[name][0], _own(name, settings))
                       for name in _IN_ALL])
    return write_page(stem, summary(rows)), every


Experiment = Callable[[str, Path, Settings], Result]
EXPERIMENTS: dict[str, tuple[str, Experiment]] = {
    "fig1": ("layout, a pixel's answer to a step, AoP events, networks",
             _overview),
    "fig2": ("error against speed, rotating polarizer", _rotation),
    "fig3": ("error against speed, plate and polarizer, both ways round", _rotation),
    "fig4a": ("a fan of polarizers, one half lit 2000 times more", _range),
    "fan": ("fig4a as pictures: what each method shows of the fan", _fan_images),
    "tendon": ("a tendon that is pulled: traces, spectra, lock-in maps", _tendon),
    "dr": ("irradiance from 40 nW/cm2 to 42 mW/cm2", _range),
    "range": ("of which angles, out of 180, AoP is right in that range", _table(
        correct_span.Level, lambda settings: progress(correct_span.levels(
            settings), correct_span.count(settings), "levels"),
        correct_span.span_page, correct_span.span_figure)),
    "flicker": ("a lamp that flickers at 120 Hz, a background", _range),
    "all": ("all of these and tables, as STEM-fig2 and so on, a table of them, and "
            "STEM.html with the pictures", _all),
    "demosaic": ("demosaicing, on scenes of known polarization", _demosaicing),
    "denoise": ("noise left and true events kept by denoising", _denoising),
    "optics": ("extinction ratio by wavelength and while aligning", _table(
        optics_bench.Point, optics_bench.points, optics_bench.bench_page,
        optics_bench.bench_figure)),
    "score": ("the score of pdavis score beside the score by the truth", _table(
        both_scores.BothScores, both_scores.both_scores,
        both_scores.both_scores_page)),
    "tables": ("the supplement's tables: specification, methods", _tables),
    "transfer": ("transfer functions, measured beside theory", _table(
        transfer.Response, transfer.transfer_rows, transfer.transfer_page,
        transfer.transfer_figure)),
    "videos": ("the five supplementary videos, as STEM-1.webm and so on, truth beside, "
               "and STEM.html that plays them", _videos),
    "network": ("networks on events alone, on these and on moving textures", _networks),
}
"""Name -> what it is, and (name, stem, settings) -> the page written, and its rows."""


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Simulate, score, write; return 0."""
    args = _parser().parse_args(argv)
    settings = _settings(args)
    if args.out.name in ("", ".."):
        raise UsageError(f"-o must name what files begin with, got '{args.out}'")
    checked_out(args.out)
    if args.recording is not None and args.figure != "fig2":
        raise UsageError(f"--recording belongs to fig2, not to {args.figure}")
    with journal(), for_people(args):
        if args.recording is None:
            page, rows = _experiment(args.figure, args.out, settings)
        else:
            page, rows = _recorded(
                args.out, _own(args.figure, settings), args)
    tell(args, [page], wrote=[beside_stem(args.out, end) for end in (".csv", ".md")],
         rows=list(map(dataclasses.asdict, rows)))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser("paper", __doc__ or "",
                    "python -m lab.paper fig2 -o fig2 --camera nominal --seeds 1 2")
    parser.prog = "python -m lab.paper"
    parser.add_argument(
        "figure", choices=list(EXPERIMENTS), metavar="FIGURE",
        help="; ".join(f"{name}: {what}" for name, (what, _) in EXPERIMENTS.items()))
    parser.add_argument(
        "-o", "--out", type=Path, required=True, metavar="STEM",
        help="writes STEM.csv, STEM.md and, with matplotlib, STEM.png, .svg and .pdf")
    parser.add_argument(
        "--camera", nargs="+", choices=EVENT_CAMERAS, metavar="PRESET",
        help=f"of {', '.join(EVENT_CAMERAS)}; default what suits the figure")
    parser.add_argument(
        "--methods", nargs="+", metavar="NAME",
        choices=[*METHODS, *network.METHODS],
        help=f"of {_named(METHODS)}; of network {_named(network.METHODS)}; default all")
    parser.add_argument(
        "--scenes", nargs="+", default=[], metavar="SCENE",
        help=f"network: of {_named(network.SCENES)}, default all; demosaic: folders of "
             "four images per scene, named alike up to the angle at the end "
             "(cup_0.png, cup_45.png, cup_90.png, cup_135.png), instead of made ones")
    parser.add_argument(
        "--weights", nargs="+", default=[], metavar="FILE",
        help="network: npz files, or a checkpoint of the published FireNet, instead of "
             "the weights that come with the package")
    parser.add_argument(
        "--rpm", type=positive, nargs="+", help="turns per minute")
    parser.add_argument(
        "--seeds", type=within(0, LAST_SEED), nargs="+",
        help="which specimens; default 1, of fig2 and fig3 without --quick "
             f"{_MANY[0]} to {_MANY[-1]}")
    parser.add_argument(
        "--starts-deg", type=number, nargs="+", default=[], metavar="DEG",
        help="angles at time 0, each with every specimen; default 17, of fig2 and "
             "fig3 with 18 more for each specimen after the first")
    parser.add_argument(
        "--seconds", type=positive, help="length of a recording, more than 1.1")
    parser.add_argument(
        "--step-us", type=within(1, 10**9), metavar="US",
        help="interval of the images scored; default 1013 (5077 with --quick, and of "
             "fig2 and fig3), which no frame clock divides")
    parser.add_argument(
        "--quick", action="store_true", help="fewer and shorter cases, a first look")
    add_json_option(parser)
    group = parser.add_argument_group(
        "a recording of your own, of a polarizer turning at constant speed (fig2)")
    group.add_argument(
        "--recording", type=Path, nargs="+", metavar="FILE",
        help="one or more, each of one speed; speed, sense and angle are fitted, "
             "errors are from the fit; --seconds is how much to read, default 10")
    group.add_argument(
        "--roi", type=roi_option, metavar="X,Y,W,H",
        help="region that the polarizer fills, even numbers; default 12x12 pixels in "
             "the middle")
    group.add_argument(
        "--layout", type=layout_option, metavar="LAYOUT",
        help="pdavis, sony or four angles by row; default what the file says")
    group.add_argument(
        "--calibration", type=Path, metavar="NPZ",
        help="what is known of this camera, as pdavis calibrate wrote it")
    group.add_argument(
        "--nominal", type=lambda text: tuple(numbers(text, 2)), metavar="ON,OFF",
        help="contrast thresholds to start from, natural-log units; default 0.2,0.2")
    return parser


def _named(methods: Iterable[str]) -> str:
    return ", ".join(map(repr, methods))


def settings_of(argv: Sequence[str]) -> Settings:
    """Return what a command line would set for its figure."""
    args = _parser().parse_args(argv)
    return _own(args.figure, _settings(args))


def _settings(args: argparse.Namespace) -> Settings:
    if args.seconds is not None and args.seconds <= 1.1:
        raise UsageError(
            f"--seconds must exceed 1.1, as the first second settles, got "
            f"{args.seconds:g}")
    if args.figure != "demosaic":
        unknown = [name for name in args.scenes if name not in network.SCENES]
        if unknown:
            raise UsageError(
                f"--scenes must be of {_named(network.SCENES)}, got {unknown[0]!r}")
    return Settings(
        cameras=None if args.camera is None else tuple(args.camera),
        seeds=tuple(args.seeds or ()), starts_deg=tuple(args.starts_deg),
        rpms=None if args.rpm is None else tuple(args.rpm),
        methods=tuple(args.methods or [*METHODS, *network.METHODS]),
        weights=tuple(args.weights), scenes=tuple(args.scenes),
        seconds=args.seconds, step_us=args.step_us or 0, quick=args.quick)


def _facts(figure: str, settings: Settings) -> dict[str, Any]:
    return {"pdavis_cv": __version__, "figure": figure, "seeds": list(settings.seeds),
            "starts_deg": [start for _, start in settings.specimens],
            "step_us": settings.step_us}


def _plots() -> Any:
    from . import plots
    return plots
