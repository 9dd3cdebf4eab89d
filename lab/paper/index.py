"""One page with all figures: what each shows, of which cameras, by which command."""
from __future__ import annotations

import glob
import html
from collections.abc import Sequence
from pathlib import Path

from pdavis_cv import __version__
from pdavis_cv._beside import write_beside

from .print_style import beside_stem
from .run import Settings

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto;
       padding: 0 1rem; color: #222; background: #fff; }
h2 { margin-top: 2.5rem; } img { max-width: 100%; height: auto; }
code { background: #f2f2f2; padding: 0 .2em; }
details { overflow-x: auto; } video { max-width: 100%; }
table { border-collapse: collapse; font-size: 85%; margin: 1em 0; }
th, td { border-top: 1px solid #ccc; padding: .2em .6em; text-align: left; }
"""

_CAPTIONS = {
    "fig1": "Fig. 1. a, layout, as the code has it; b, a pixel's answer to a step of "
    "the light, simulated without noise; c, AoP events of a rectangular polarizer that "
    "turns, their colour the angle as in d; d, those inside it beside the truth. "
    "Networks: frame, events, and S0, AoP and DoLP of a moving texture by firenet and "
    "joint, below the truth.",
    "fig2": "Fig. 2. Mean absolute errors behind a turning polarizer: a, of "
    "super-pixels; b, of the mean of 12 x 12 pixels, as in the paper, whose limits are "
    "arrows; c, DoLP of that mean; bounds are the least errors that physics leaves "
    "cameras that nobody calibrated, their bands the bounds' standard error. d, event "
    "rate; e, times between a pixel's events; f, one pixel's events over a turn. "
    "Traces: AoP and DoLP of the mean over time, truth grey behind.",
    "fig3": "Fig. 3. As Fig. 2, with a quarter-wave plate that turns behind a fixed "
    "polarizer (the paper's text) and with a polarizer that turns before a fixed plate "
    "(its supplement): a, b, AoP and DoLP of super-pixels; c, growth of the DoLP "
    "error of the mean from the lowest speed.",
    "fig4a": "Fig. 4a in numbers: AoP errors of super-pixels in the dark and the "
    "bright half of the fan.",
    "fan": "Fig. 4a. I0, AoP and DoLP of the fan at two speeds by each method, below "
    "the truth; error of AoP along a circle half way to the rim; AoP's uncertainty as "
    "kalman states it beside its error.",
    "tendon": "Fig. 4b. a, c, DoLP of the mean of a tendon that is pulled at 1 and 10 "
    "Hz, frames, cf, kalman and networks; b, d, its spectrum; last, amplitude of each "
    "super-pixel at the load's frequency.",
    "dr": "Super-pixels' AoP errors by irradiance, behind a polarizer and a turning "
    "plate; last, the region's mean.",
    "range": "The supplement's dynamic range: a, of which angles, out of 180 degrees, "
    "AoP of a region is within 10 degrees of the truth; b, the paper's axis, largest "
    "less smallest angle; c, error. Bars are the paper's ranges.",
    "flicker": "A lamp of 1 + 0.1 cos(2 pi 120 Hz t) beside a steady one.",
    "optics": "Extinction ratio by wavelength, measured by Malus's law beside "
    "published truth; c, that of orthogonal neighbours while an array lies beside the "
    "pixels.",
    "transfer": "Transfer function: a, gain, b, phase of log intensity by frequency, "
    "measured as marks, theory as lines.",
    "denoise": "a, events within a disc of turning polarized light and noise; b, what "
    "EventDenoiser keeps; c, rates by speed.",
    "network": "Networks on events alone beside other methods: errors of super-pixels "
    "by scene; marks are medians of speeds and textures, lines their range.",
    "tables": "Tables S1 and S2.",
    "videos": "Supplementary Videos 1 to 5, truth at the left.",
}
"""What a figure's panels show, and by which method."""


def write_index(stem: Path, figures: Sequence[tuple[str, str, Settings]]) -> None:
    """Write STEM.html: the pictures STEM-NAME*.png, with captions and numbers.

    Parameters
    ----------
    stem : path
    figures : sequence of (str, str, Settings)
        Name, what it shows, and of which specimens and speeds, in order.
    """
    lines = ["# The paper's figures, simulated", "",
             f"All methods in [one table](<{stem.name}.md>).", ""]
    for name, what, settings in figures:
        start = f"{stem.name}-{name}"
        pictures = sorted(stem.parent.glob(f"{glob.escape(start)}*.png"))
        quick = " --quick" * settings.quick
        page = beside_stem(stem, f"-{name}.md")
        text = page.read_text(encoding="utf-8") if page.exists() else ""
        lines += [
            f"## {name}", "", *(f"![{what}](<{one.name}>)" for one in pictures), "",
            f"{_CAPTIONS.get(name, what + '.')} {_of(name, settings)} "
            f"`python -m lab.paper {name}{quick}`, pdavis_cv {__version__}. "
            f"[Table](<{start}.csv>).", "", "<details><summary>numbers</summary>", "",
            *text.splitlines()[1:], "", "</details>", ""]
    write_html(stem, lines)


def played(name: str) -> str:
    """Return a line of Markdown that plays a video."""
    return f'<video src="{html.escape(name)}" controls loop muted></video>'


def write_html(stem: Path, lines: Sequence[str]) -> None:
    """Write STEM.html, a page on its own, from Markdown whose first line is its title.

    Raises
    ------
    ImportError
        Without markdown-it-py.
    """
    from markdown_it import MarkdownIt

    body = MarkdownIt("commonmark").enable("table").render("\n".join(lines))
    text = (
        '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" '
        f'content="width=device-width"><title>{html.escape(lines[0].lstrip("# "))}'
        f"</title><style>{_STYLE}</style>{body}</html>\n")
    with write_beside(beside_stem(stem, ".html")) as unfinished:
        unfinished.write_text(text, encoding="utf-8")


# Of what else than the cameras asked for a figure is.
_CAMERAS = {"transfer": "ideal, without noise and mismatch"}


def _of(name: str, settings: Settings) -> str:
    """Say of which cameras and specimens a figure is."""
    cameras = _CAMERAS.get(name, ", ".join(settings.cameras or ("nominal",)))
    if name == "transfer":
        return f"Cameras {cameras}."
    return (f"Cameras {cameras}; {settings.told_specimens}; an image every "
            f"{settings.step_us} us.")
