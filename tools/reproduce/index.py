"""One page with all figures: what each shows, of which cameras, by which command."""
from __future__ import annotations

import glob
import html
from collections.abc import Sequence
from pathlib import Path

from pdavis_cv import __version__
from pdavis_cv.export import write_beside

from .print_style import SUFFIXES, beside_stem
from .run import Settings

__all__ = ["write_html", "write_index"]

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto;
       padding: 0 1rem; color: #222; background: #fff; }
figure { margin: 2.5rem 0; } img { max-width: 100%; height: auto; }
figcaption { color: #444; } code { background: #f2f2f2; padding: 0 .2em; }
"""


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
        caption = (f"<b>{html.escape(name)}</b>: {html.escape(what)}. "
                   f"{html.escape(_of(settings))} <code>pdavis reproduce {name}"
                   f"{' --quick' if settings.quick else ''}</code>, pdavis_cv "
                   f"{__version__}. <a href=\"{html.escape(stem.name)}-{name}.md\">"
                   f"Numbers</a>, <a href=\"{html.escape(stem.name)}-{name}.csv\">table"
                   "</a>.")
        pictures = "".join(
            f'<img src="{html.escape(one)}.png" alt="{html.escape(what)}"><br>'
            + " ".join(f'<a href="{html.escape(one)}.{kind}">{kind.upper()}</a>'
                       for kind in SUFFIXES) for one in found)
        parts.append(f"<figure>{pictures}<figcaption>{caption}</figcaption></figure>")
    table = html.escape(f"{stem.name}.md")
    write_html(stem, "The paper's figures, simulated",
               f'<p>All methods in <a href="{table}">one table</a>.</p>'
               + "\n".join(parts))


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


def _of(settings: Settings) -> str:
    """Say of which specimens the figures are."""
    cameras = ", ".join(settings.cameras or ("nominal",))
    return (f"Cameras {cameras}; {settings.told_specimens}; an image every "
            f"{settings.step_us} us.")
