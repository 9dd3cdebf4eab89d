"""One page with all figures: what each shows, of which cameras, by which command."""
from __future__ import annotations

import glob
import html
import re
from collections.abc import Sequence
from pathlib import Path

from pdavis_cv import __version__
from pdavis_cv.export import write_beside

from .print_style import SUFFIXES, beside_stem
from .run import Settings

__all__ = ["as_html", "write_html", "write_index"]

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto;
       padding: 0 1rem; color: #222; background: #fff; }
figure { margin: 2.5rem 0; } img { max-width: 100%; height: auto; }
figcaption { color: #444; } code { background: #f2f2f2; padding: 0 .2em; }
details { overflow-x: auto; } video { max-width: 100%; }
table { border-collapse: collapse; font-size: 85%; margin: 1em 0; }
th, td { border-top: 1px solid #ccc; padding: .2em .6em; text-align: left; }
"""

_CAPTIONS = {
    "fig1": "Fig. 1. a, layout, as the code has it; b, stack; c, a pixel's answer to a "
    "step of the light, simulated without noise; d, AoP events of a rectangular "
    "polarizer that turns, their colour the angle as in e; e, those inside it beside "
    "the truth. Networks: frame, events, and S0, AoP and DoLP of a moving texture by "
    "firenet and joint, below the truth.",
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
    "robustness": "Errors of each method on cameras and light that depart from what is "
    "assumed; colour is the error over the least of the same causality.",
    "tables": "Tables S1 and S2.",
    "videos": "Supplementary Videos 1 to 5, truth at the left.",
}
"""What a figure's panels show, and by which method."""


def write_index(stem: Path, figures: Sequence[tuple[str, str, Settings]]) -> None:
    """Write STEM.html: the pictures STEM-NAME*.png, with captions.

    Parameters
    ----------
    stem : path
    figures : sequence of (str, str, Settings)
        Name, what it shows, and of which specimens and speeds, in order.
    """
    parts = []
    for name, what, settings in figures:
        found = sorted(path.name.removesuffix(".png") for path in stem.parent.glob(
            f"{glob.escape(stem.name)}-{name}*.png"))
        caption = (f"<b>{html.escape(name)}</b>: "
                   f"{html.escape(_CAPTIONS.get(name, what + '.'))} "
                   f"{html.escape(_of(name, settings))} <code>python -m lab.paper {name}"
                   f"{' --quick' if settings.quick else ''}</code>, pdavis_cv "
                   f"{__version__}. <a href=\"{html.escape(stem.name)}-{name}.md\">"
                   f"Numbers</a>, <a href=\"{html.escape(stem.name)}-{name}.csv\">table"
                   "</a>.")
        pictures = "".join(
            f'<img src="{html.escape(one)}.png" alt="{html.escape(what)}"><br>'
            + " ".join(f'<a href="{html.escape(one)}.{kind}">{kind.upper()}</a>'
                       for kind in SUFFIXES) for one in found)
        pictures += "".join(
            f'<video src="{html.escape(path.name)}" controls loop muted></video>'
            for path in sorted(stem.parent.glob(
                f"{glob.escape(stem.name)}-{name}-*.webm")))
        numbers = _numbers(beside_stem(stem, f"-{name}.md"), opened=not pictures)
        parts.append(f'<figure id="{html.escape(name)}">{pictures}<figcaption>{caption}'
                     f"</figcaption>{numbers}</figure>")
    table = html.escape(f"{stem.name}.md")
    write_html(stem, "The paper's figures, simulated",
               f'<p>All methods in <a href="{table}">one table</a>.</p>'
               + "\n".join(parts))


def _numbers(page: Path, opened: bool) -> str:
    """Return a page's tables and text as HTML that can be unfolded."""
    if not page.exists():
        return ""
    body = as_html(page.read_text(encoding="utf-8").splitlines()[1:])
    return (f"<details{' open' if opened else ''}><summary>numbers</summary>{body}"
            "</details>")


def as_html(lines: Sequence[str]) -> str:
    """Return the Markdown that `write_page` writes as HTML.

    Parameters
    ----------
    lines : sequence of str
        Headings, tables, and paragraphs with code and bold words.
    """
    parts, rows = [], []
    for line in [*lines, ""]:
        if line.startswith("|"):
            rows.append([_inline(cell.strip()) for cell in line.strip("|").split("|")])
            continue
        if rows:
            head, body = rows[0], rows[2:]
            parts.append("<table><tr>" + "".join(f"<th>{cell}</th>" for cell in head)
                         + "</tr>" + "".join(
                "<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>"
                for row in body) + "</table>")
            rows = []
        if line.startswith("#"):
            parts.append(f"<h3>{_inline(line.lstrip('# '))}</h3>")
        elif line:
            parts.append(f"<p>{_inline(line)}</p>")
    return "".join(parts)


def _inline(text: str) -> str:
    text = re.sub(r"`([^`]*)`", r"<code>\1</code>", html.escape(text))
    return re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", text)


def write_html(stem: Path, title: str, body: str) -> None:
    """Write STEM.html, a page on its own.

    Parameters
    ----------
    stem : path
    title, body : str
        HTML.
    """
    text = (
        '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" '
        f'content="width=device-width"><title>{title}</title><style>{_STYLE}</style>'
        f"<h1>{title}</h1>{body}</html>\n")
    with write_beside(beside_stem(stem, ".html")) as unfinished:
        unfinished.write_text(text, encoding="utf-8")


# Of what else than the cameras asked for a figure is.
_CAMERAS = {"transfer": "ideal, without noise and mismatch",
            "robustness": "nominal and davis346, changed as each line says"}


def _of(name: str, settings: Settings) -> str:
    """Say of which cameras and specimens a figure is."""
    cameras = _CAMERAS.get(name, ", ".join(settings.cameras or ("nominal",)))
    if name == "transfer":
        return f"Cameras {cameras}."
    return (f"Cameras {cameras}; {settings.told_specimens}; an image every "
            f"{settings.step_us} us.")
