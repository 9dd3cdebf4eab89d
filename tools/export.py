"""Fuse a recording into a video, pictures or arrays.

The suffix of OUT determines the output: .webm (browsers play it), .mp4 (H.264, which
slide programs play, where PyAV has an encoder, else VP9), .mkv and .avi a colour video;
.webp and .gif the same for slides; .png pictures and .pdf or .svg figures for print,
numbered if there are several; .ome.tif, .ome.zarr, .h5, .npz and .npy float stacks (AoP
in radians) with names, units, times and provenance, of .npy in a .json file next to it,
which --resume can continue; .mcap and .db3 ROS 2 bags with the quantities as 32FC1
images and a colour picture.
"""
from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pdavis_cv import PolarFrame, Recording, export, fuse, render
from pdavis_cv._opencv import opencv
from pdavis_cv._packages import package
from pdavis_cv.colour_mosaic import COLOURS
from pdavis_cv.mosaic import HALF_SIZE
from pdavis_cv.quantities import GROUPS, INTENSITY, QUANTITIES, chosen
from pdavis_cv.recording.base import start_of
from pdavis_cv.render.colours import Picture

from ._aop_events import SUFFIXES, export_aop_events
from ._common import (
    Parser,
    UsageError,
    add_json_option,
    checked_out,
    command,
    covered,
    require_samples,
    tell,
)
from ._images import full_scale, screen_scale, told_if_nothing
from ._options import add_file, add_fuse_options, fuse_options, opened
from ._progress import progress, stage
from ._values import numbers, positive, since_start, within

_STACKS: dict[str, type[export.StackFile]] = {
    ".tif": export.OmeTiffFile, ".h5": export.Hdf5File, ".npz": export.NpzFile,
    ".npy": export.NpyFile, ".zarr": export.OmeZarrFile}
_BAGS = (".mcap", ".db3")
_COLOUR = (".webm", ".mp4", ".m4v", ".mkv", ".avi", *export.ANIMATIONS)
_LEAST_WIDTH = 240      # of a panel: below, captions do not fit
_FIGURE_PIXELS = 700    # of a panel of a figure with a scale bar, whose text is pixels
_WIDTH_MM, _DPI = 180.0, 300.0


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pdavis export``."""
    args = _parser().parse_args(argv)
    suffix = args.out.suffix.lower()
    if args.what == "aop-events":
        return _aop_events(args, suffix)
    known = (*_COLOUR, *export.FIGURES, *_STACKS, *_BAGS)
    if suffix not in known:
        raise UsageError(f"-o must end in {', '.join(known)}, got {args.out}")
    if figure(args):
        package("matplotlib", "a figure needs matplotlib: pip install matplotlib")
    if args.resume and suffix not in _STACKS:
        raise UsageError(f"--resume continues {', '.join(_STACKS)}, got {args.out}")
    if _ranges(args) and suffix in _STACKS:
        raise UsageError(
            f"--range is for pictures; {suffix} holds the numbers themselves")
    checked_out(args.out, args.file)
    if suffix not in _STACKS:
        opencv()  # report a missing package before the work
    with opened(args) as recording:
        options = fuse_options(args, recording)
        if args.at is not None:
            if (args.start_us, args.stop_us, args.fps) != (None, None, None):
                raise UsageError(
                    "--at is one image: it excludes --start, --stop and --fps")
            at = start_of(recording) + round(args.at * 1e6)
            require_samples(recording, at)
            options |= {"fps": None, "times_us": [at]}
        images = iter(told_if_nothing(
            fuse(recording, **options), recording, options["calibration"]))
        if args.colour is not None:
            images = (_of_colour(frame, args.colour) for frame in images)
        stage("estimating parameters of the camera")
        first = list(itertools.islice(images, 2))
        if not first:
            raise UsageError(
                f"{recording.name}: no image in the interval asked for: "
                f"{covered(recording)}")
        rate = _playing_rate(first, options["fps"], args.slow)
        total = _expected(recording, options, first)
        frames = iter(progress(itertools.chain(first, images), total, "images"))
        facts: dict[str, Any]
        if suffix in _STACKS:
            lines, facts = _write_stack(args, frames, recording, first[0])
        elif suffix in _BAGS:
            lines, facts = _write_bag(args, frames, recording, first[0])
        elif suffix in export.FIGURES:
            lines, facts = _write_pictures(
                args, frames, Sheet(args, recording, first[0]), single=len(first) == 1)
        else:
            lines, facts = _write_video(
                args, frames, rate, Sheet(args, recording, first[0]))
        lines += first[0].provenance["assumed"]
        units = [*export.units(args.quantities, recording).values()]
        if options["fps"] is None and args.at is None and (
                recording.info.event_count != 0 and recording.info.frame_count != 0):
            lines.append(
                "one image for each frame; --fps 200 makes 200 per second, by events")
    tell(args, lines, method=first[0].provenance["method"],
         assumed=first[0].provenance["assumed"],
         quantities=args.quantities,
         units=units, **facts)
    return 0


def _aop_events(args: argparse.Namespace, suffix: str) -> int:
    if suffix not in SUFFIXES:
        raise UsageError(
            f"-o of AoP events must end in {', '.join(SUFFIXES)}, got {args.out}")
    checked_out(args.out, args.file)
    with opened(args) as recording:
        lines, facts = export_aop_events(args, recording, fuse_options(args, recording))
    tell(args, lines, **facts)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        "export", __doc__ or "",
        "pdavis export recording.aedat4 -o fused.webm --fps 200 --slow 8")
    add = parser.add_argument
    names = [*(name for name in QUANTITIES if name != "events"), *GROUPS]
    add_file(parser, "a recording")
    add("-o", "--out", type=Path, required=True, metavar="OUT", help="file to write")
    add("--what", choices=("images", "aop-events"), default="images",
        help="aop-events: an angle after each event instead of images, as .csv, .npy "
             "or a video in which events have the hue of their angle; with --set "
             "cutoff_hz=, radius=, correct_phase=true; default images")
    add("--at", type=since_start, metavar="S",
        help="one image, at this time in seconds after the start of the recording")
    add("--quantities", type=_quantities, default=["s0", "aop", "dolp"], metavar="LIST",
        help=f"quantities from {', '.join(names)}; default s0,aop,dolp")
    add("--colour", choices=COLOURS, help="of a colour sensor, images of this light "
        "alone; default: of all light together, half of which is green")
    add("--range", type=_range, action="append", default=[], metavar="[NAME=]LOW,HIGH",
        dest="ranges", help="values at the ends of a quantity's colours, e.g. "
        "dolp=0,0.3 (the upper one is also that of full colour in faded AoP); "
        "repeatable; default: dolp 0,1, intensities up to --white")
    add("--pixel-um", type=positive, metavar="UM",
        help="size of a pixel in the object: pictures get a scale bar, stacks store it")
    add("--resume", action="store_true",
        help="keep the stack if interrupted, and continue an interrupted one")
    look = parser.add_argument_group("pictures").add_argument
    look("--slow", type=positive, default=1.0, metavar="FACTOR",
         help="factor of slow motion of a video; default 1")
    look("--white", type=positive, metavar="DN/MS",
         help="intensity shown as white; default: from the first image, then fixed")
    look("--white-balance", type=_balance, metavar="R,G,B",
         help="of a colour sensor, what red, green and blue are multiplied by in the "
              "picture of s0; default: what makes the mean of the first image grey")
    look("--aop", choices=("faded", "hsv", "full"), default="faded",
         help="colours of the angle: faded (default): equal steps look equal, fading "
              "where DoLP is low or the angle's standard deviation is above "
              f"{render.HIDDEN_SIGMA_DEG:g} degrees; hsv: the same in hues of HSV; "
              "full: even colours for any DoLP")
    look("--mask-dolp", type=positive, metavar="DOLP",
         help="grey out AoP of weaker polarization")
    look("--mask-sigma", type=positive, metavar="DEG",
         help="grey out AoP with a larger standard deviation (needs kalman)")
    look("--background", choices=("dark", "light"), help="background of the pictures, "
         "to which AoP fades; default dark, light in figures")
    look("--scale", type=within(1, 32), metavar="N",
         help="each pixel becomes N x N; default: panels at least 240 pixels wide, in "
              "videos also 480 high; text and legends grow along")
    look("--width-mm", type=positive, metavar="MM", help="width of a figure in print: "
         f".pdf and .svg (text as text), or .png; default {_WIDTH_MM:g}")
    look("--dpi", type=positive, metavar="N",
         help=f"pixels per inch of a figure in .png; default {_DPI:g}")
    look("--title", default="", help="a line above each picture")
    look("--per-row", type=within(1, 64), metavar="N",
         help="number of panels per row; default: all")
    look("--bare", action="store_true", help="no titles, no legends, no margins")
    add_json_option(parser)
    add_fuse_options(parser)
    return parser


def _quantities(text: str) -> list[str]:
    try:
        return [one.name for one in chosen(text.split(","))]
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _of_colour(frame: PolarFrame, colour: str) -> PolarFrame:
    if not frame.colours:
        raise UsageError("--colour needs a sensor of colours (--layout sony-rggb)")
    return frame.colours[colour]


def _balance(text: str) -> tuple[float, ...]:
    gains = numbers(text, 3)
    if min(gains) <= 0:
        raise argparse.ArgumentTypeError(f"gains must be positive, got {text!r}")
    return tuple(gains)


def _grey_mean(frame: PolarFrame) -> tuple[float, ...]:
    """Return the white balance that makes the mean of an image grey."""
    means = [float(frame.colours[name].s0[frame.valid].mean() if frame.valid.any()
                   else 1) for name in COLOURS]
    return tuple(round(sum(means) / 3 / max(mean, 1e-9), 3) for mean in means)


def _range(text: str) -> tuple[str | None, float, float]:
    name, equals, ends = text.rpartition("=")
    low, high = numbers(ends, 2)
    if not low < high:
        raise argparse.ArgumentTypeError(f"LOW must be below HIGH, got {text!r}")
    return _quantities(name)[0] if equals else None, low, high


def _ranges(args: argparse.Namespace) -> dict[str, tuple[float, float]]:
    """Return the given ranges by quantity; a range may omit the name of the only one.

    One that is ambiguous, or cannot have a range, is a UsageError.
    """
    found: dict[str, tuple[float, float]] = {}
    for name, low, high in args.ranges:
        if name is None and len(args.quantities) != 1:
            raise UsageError(
                f"--range {low:g},{high:g}: of which quantity? "
                f"e.g. --range {args.quantities[-1]}={low:g},{high:g}")
        name = name or args.quantities[0]
        if name not in args.quantities and not (
                name == "dolp" and "aop" in args.quantities):
            raise UsageError(f"--range {name}: it is not among --quantities")
        if name == "aop":
            raise UsageError("--range aop: colours of the angle go round, 0 to 180 deg")
        found[name] = low, high
    return found


class Sheet:
    """The appearance of an export's images, fixed when it starts.

    The recording determines the name and the zero of time in the title, the first image
    the white of intensities unless --white is given.
    """

    def __init__(
        self, args: argparse.Namespace, recording: Recording, first: PolarFrame
    ) -> None:
        self.args = args
        self.origin_us = start_of(recording)
        self.source = recording.name
        self.facts = export.provenance(first.provenance, recording)
        top = full_scale(recording)
        self.unit = export.light_unit(recording)
        self.white = float(args.white or _white(first, top))
        self.saturated = math.inf if top is None else top / 2
        self._balance: tuple[float, ...] = ()
        if first.colours and "s0" in args.quantities:
            self._balance = args.white_balance or _grey_mean(first)
            self.facts = {**self.facts, "white_balance": self._balance}
        elif args.white_balance:
            raise UsageError("--white-balance needs s0 of a sensor of colours")
        self.ranges = {name: QUANTITIES[name].shown(self.white) for name in
                       args.quantities} | _ranges(args)
        self.fading = _ranges(args).get("dolp", (0.0, render.FULL_COLOUR_DOLP))
        ground = args.background or ("light" if figure(args) else "dark")
        self.style = render.LIGHT if ground == "light" else render.DARK
        suffix = args.out.suffix.lower()
        self.columns = args.per_row or len(args.quantities)
        self._scale = args.scale or 1 if args.bare else args.scale or max(
            -(-_LEAST_WIDTH // first.shape[1]),
            screen_scale(first.shape) if suffix in _COLOUR else 1)
        if not args.bare:
            self.style = self.style.sized(self._scale * first.shape[1])
        self._pixel_um = args.pixel_um and args.pixel_um * (
            2 if first.provenance.get("demosaic") in HALF_SIZE else 1)
        self.panels = [self._panel(name) for name in args.quantities]
        self._width: int | None = None

    def write(self, path: Path, frame: PolarFrame) -> None:
        """Write the picture or figure of one image."""
        if not figure(self.args):
            export.write_png(path, self.picture(frame), self.facts)
            return
        pictures = self._pictures(frame)
        if self._pixel_um is not None:
            scale = -(-_FIGURE_PIXELS // frame.shape[1])
            pictures = [self._enlarged(one, scale) for one in pictures]
        export.write_figure(
            path, pictures, self.panels, width_mm=self.args.width_mm or _WIDTH_MM,
            columns=self.columns, title=self._title(frame), style=self.style,
            dpi=self.args.dpi or _DPI, facts=self.facts)

    def _title(self, frame: PolarFrame) -> str:
        seconds = (frame.t_us or 0) / 1e6 - self.origin_us / 1e6
        method = frame.provenance["method"]
        return f"{self.source}   {method}   t = {seconds:.4f} s   {self.args.title}"

    def picture(self, frame: PolarFrame) -> Picture:
        """Compose the picture of one image."""
        pictures = self._pictures(frame)
        if self.args.bare:
            whole = render.tile(pictures, columns=self.columns, gap=0)
            return whole.repeat(self._scale, 0).repeat(self._scale, 1)
        sheet = render.tile([
            render.panel(self._enlarged(one, self._scale), **panel._asdict(),
                         style=self.style)
            for one, panel in zip(pictures, self.panels, strict=True)],
            columns=self.columns, title=self._title(frame).rstrip(), style=self.style)
        # The pictures of a video have one size, whatever the length of the title.
        self._width = self._width or sheet.shape[1]
        missing = max(self._width - sheet.shape[1], 0)
        return np.pad(sheet, ((0, 0), (0, missing), (0, 0)),
                      constant_values=self.style.ground)[:, :self._width]

    def _enlarged(self, picture: Picture, scale: int) -> Picture:
        picture = picture.repeat(scale, 1).repeat(scale, 0)
        return picture if self._pixel_um is None else render.scale_bar(
            picture, self._pixel_um, scale=scale)

    def _pictures(self, frame: PolarFrame) -> list[Picture]:
        return [self._picture(frame, name) for name in self.args.quantities]

    def _picture(self, frame: PolarFrame, name: str) -> Picture:
        low, high = self.ranges[name]
        if name == "aop":
            return self._aop(frame)
        if name == "s0" and self._balance and low == 0:
            return render.colour_bgr(
                frame, high, self._balance, saturated=self.saturated)
        return render.quantity_bgr(
            QUANTITIES[name], frame, low, high, saturated=self.saturated)

    def _aop(self, frame: PolarFrame) -> Picture:
        good = render.reliable(frame, least_dolp=self.args.mask_dolp,
                               most_sigma_deg=self.args.mask_sigma)
        picture = render.aop_bgr(
            frame.aop, frame.valid,
            colours="hsv" if self.args.aop == "hsv" else "even")
        if self.args.aop != "full":
            low, high = self.fading
            render.fade_aop(picture, frame, low=low, top=high, ground=self.style.ground)
        picture[frame.valid & ~good] = render.MASKED
        return picture

    @property
    def brightest(self) -> str:
        """The intensity that is shown white, with its unit."""
        balance = ", ".join(f"{gain:g}" for gain in self._balance)
        return f"{self.white:g} {self.unit}".removesuffix(" 1") + (
            balance and f", white balance {balance}")

    def _panel(self, name: str) -> render.Panel:
        one = QUANTITIES[name]
        if name == "aop":
            legend = "aop" if self.args.aop == "full" else self.args.aop
            return render.Panel(one.title, legend, end=f"{self.fading[1]:g}")
        low, high = self.ranges[name]
        unit = self.unit if one.unit == INTENSITY else one.unit
        unit = "" if unit == "1" else f" {unit}"
        if one.unit == "rad":
            low, high, unit = math.degrees(low), math.degrees(high), " deg"
        return render.Panel(
            one.title, "dolp" if one.colours == "viridis" else "grey", f"{low:.4g}",
            f"{high:.4g}{unit}")


def figure(args: argparse.Namespace) -> bool:
    """Return whether the output is a figure of a physical size."""
    suffix = args.out.suffix.lower()
    sized = (args.width_mm, args.dpi) != (None, None)
    if sized and suffix not in export.FIGURES:
        raise UsageError(
            f"--width-mm and --dpi are for {', '.join(export.FIGURES)}, got {args.out}")
    found: bool = suffix in (".pdf", ".svg") or sized
    if found and (args.bare or args.scale):
        raise UsageError("--bare and --scale are for pictures; a figure has a width")
    return found


def _white(frame: PolarFrame, top: float | None) -> float:
    """Return a round intensity slightly above all but the brightest pixels."""
    usable = frame.s0[frame.valid & np.isfinite(frame.s0)]
    bright = float(np.percentile(usable, 99)) * 1.1 if usable.size else 0.0
    if not bright > 0:
        return 1.0 if top is None else top
    digit = 10.0 ** (math.floor(math.log10(bright)) - 1)
    return math.ceil(bright / digit) * digit


def _playing_rate(first: Sequence[PolarFrame], fps: float | None, slow: float) -> float:
    times = [frame.t_us for frame in first if frame.t_us is not None]
    if fps is None:
        fps = 1e6 / (times[1] - times[0]) if len(times) == 2 else 25.0
    return fps / slow


def _expected(
    recording: Recording, options: dict[str, Any], first: Sequence[PolarFrame]
) -> int | None:
    """Return the number of images, if it is known in advance."""
    stop: int | None = options["stop_us"] or recording.info.stop_us
    fps: float | None = options["fps"]
    if fps is None or stop is None or first[0].t_us is None:
        return recording.info.frame_count if options.get("times_us") is None else 1
    return math.ceil((stop - first[0].t_us) * fps / 1e6)


def _write_video(
    args: argparse.Namespace, frames: Iterator[PolarFrame], rate: float, sheet: Sheet
) -> tuple[list[str], dict[str, Any]]:
    with export.moving_file(args.out, rate, sheet.facts) as video:
        for frame in frames:
            picture = sheet.picture(frame)
            video.add(picture)
    height, width = picture.shape[:2]
    line = (f"wrote {args.out}: {video.count} pictures of {width}x{height}, "
            f"{rate:g} per second, {video.codec}; white is {sheet.brightest}")
    return [line], {"wrote": [args.out], "images": video.count, "playing_fps": rate,
                    "codec": video.codec, "white": sheet.white}


def _write_bag(
    args: argparse.Namespace, frames: Iterator[PolarFrame], recording: Recording,
    first: PolarFrame,
) -> tuple[list[str], dict[str, Any]]:
    sheet = Sheet(args, recording, first)
    facts = export.provenance(first.provenance, recording, units=export.units(
        args.quantities, recording))
    with export.BagFile(args.out, args.quantities, first.shape, facts) as bag:
        for frame in frames:
            bag.add(frame, sheet.picture(frame))
    return [f"wrote {args.out}: {bag.count} images of {', '.join(args.quantities)} and "
            "a picture, as messages"], {"wrote": [args.out], "images": bag.count}


def _write_pictures(
    args: argparse.Namespace, frames: Iterator[PolarFrame], sheet: Sheet, *,
    single: bool,
) -> tuple[list[str], dict[str, Any]]:
    written = []
    for i, frame in enumerate(frames):
        path = args.out
        if not single:
            path = path.with_stem(f"{path.stem}-{i:05d}")
        sheet.write(path, frame)
        written.append(path)
    last = f" .. {written[-1].name}" if len(written) > 1 else ""
    return [f"wrote {written[0]}{last}; white is {sheet.brightest}"], {
        "wrote": written, "images": len(written), "white": sheet.white}


def _write_stack(
    args: argparse.Namespace, frames: Iterator[PolarFrame], recording: Recording,
    first: PolarFrame,
) -> tuple[list[str], dict[str, Any]]:
    facts = export.provenance(first.provenance, recording, units=export.units(
        args.quantities, recording))
    kind = _STACKS[args.out.suffix.lower()]
    with kind(args.out, args.quantities, facts, pixel_um=args.pixel_um,
              resume=args.resume) as file:
        done = file.count
        for frame in itertools.islice(frames, done, None):
            file.add(frame)
    height, width = first.shape
    continued = f", {done} of them from before" if done else ""
    line = (f"wrote {args.out}: float32, {file.count} x {len(file.quantities)} x "
            f"{height} x {width} ({', '.join(file.quantities)}){continued}")
    return [line], {"wrote": [args.out], "images": file.count,
                    "shape": [file.count, len(file.quantities), height, width],
                    "continued": done}
