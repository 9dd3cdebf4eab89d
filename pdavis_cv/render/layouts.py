"""Sheets in the layout of the paper's Supplementary Videos 1 to 5, and summaries."""
from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._checks import typed, whole_number
from pdavis_cv._opencv import opencv
from pdavis_cv._types import Image
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.render.colours import MASKED, Picture, aop_bgr, dolp_bgr
from pdavis_cv.render.legends import DARK, even, panel, stack, tile
from pdavis_cv.render.overlay import fade_aop, reliable
from pdavis_cv.render.tone import ToneCurve

_LEAST_WIDTH = 240  # of a panel, so that small images are visible and captions fit
Grey = Callable[[ArrayLike, NDArray[np.bool_] | None], Picture]


def summary(image: PolarFrame) -> Picture:
    """Lay out one image for a first look: S0, AoP faded by DoLP, and DoLP.

    Parameters
    ----------
    image : PolarFrame
        S0 is shown with a tone curve fitted to this image.

    Returns
    -------
    ndarray of uint8, shape (H', W', 3)
        BGR of even size.
    """
    typed("image", image, PolarFrame, "a PolarFrame")
    grey = (ToneCurve.of([image.s0], [image.valid]) if image.valid.any()
            else ToneCurve(1.0))
    colour = aop_bgr(image.aop, image.valid)
    fade_aop(colour, image)
    scale = max(1, -(-_LEAST_WIDTH // image.shape[1]))
    style = DARK.sized(scale * image.shape[1])
    return tile([
        panel(grey.bgr(image.s0, image.valid), "S0", legend="grey",
              end=f"{grey.white:.4g}", scale=scale, style=style),
        panel(colour, "AoP, black where DoLP is 0", legend="faded",
              scale=scale, style=style),
        panel(dolp_bgr(image.dolp, image.valid), "DoLP", legend="dolp", scale=scale,
              style=style)], columns=3, style=style)


def png_of(picture: Image) -> bytes:
    """Return a picture as the bytes of a PNG file.

    Parameters
    ----------
    picture : ndarray of uint8 or uint16, shape (H, W, 3) or (H, W)
        BGR or grey.

    Raises
    ------
    TypeError
        If it is something else, such as a plane of floats, which has no colours yet.
    ImportError
        If OpenCV is missing.
    OSError
        If it cannot encode this picture.
    """
    if getattr(picture, "dtype", None) not in (np.uint8, np.uint16):
        raise TypeError(
            "picture must be uint8 or uint16, got "
            f"{getattr(picture, 'dtype', type(picture).__name__)}; render.aop_bgr, "
            "dolp_bgr, grey_bgr and summary make pictures")
    done, data = opencv().imencode(".png", picture)
    if not done:
        raise OSError(f"OpenCV cannot encode {picture.shape} as PNG")
    return bytes(data)



def fan_sheet(
    rows: Sequence[tuple[str, PolarFrame, Grey]], *, scale: int = 1, title: str = "",
    least_dolp: float | None = 0.3,
    marks: Callable[[Picture], Picture] | None = None,
) -> Picture:
    """Lay out Supplementary Videos 3 and 4: I0, AoP and DoLP, a row per source.

    Parameters
    ----------
    rows : sequence of (str, PolarFrame, callable)
        Name, image and tone curve of each source, top first: PDAVIS frames, fused,
        and a second camera if there is one.
    scale : int
        Picture pixels per pixel of the first source; others are resized to its height
        by nearest neighbours.
    title : str
        One line over all.
    least_dolp : float, optional
        AoP of weaker polarization is masked, as in the paper's figure.
    marks : callable, optional
        Draws on the AoP pictures, e.g. sectors.

    Returns
    -------
    ndarray of uint8, shape (H', W', 3)
        BGR of even size.
    """
    if not rows:
        raise ValueError("rows must be one or more, got none")
    sheets = []
    height, width = rows[0][1].shape
    style = DARK.sized(width * scale)
    for i, (name, frame, grey) in enumerate(rows):
        good = reliable(frame, least_dolp=least_dolp)
        colour = aop_bgr(frame.aop, frame.valid)
        colour[frame.valid & ~good] = MASKED
        last = i == len(rows) - 1
        sheets.append(tile([
            panel(_to_height(picture, height, scale), f"{name}: {what}",
                  legend=legend if last else None, style=style)
            for picture, what, legend in (
                (grey(frame.quad[0], frame.valid), "I0", None),
                (colour if marks is None or i else marks(colour), "AoP", "aop"),
                (dolp_bgr(frame.dolp, frame.valid), "DoLP", "dolp"))],
            columns=3, title="" if i else title, style=style))
    return even(stack(sheets))


def tendon_sheet(
    held: PolarFrame, events: Picture, fused: PolarFrame, below: Picture, *,
    grey: Grey, top: float, scale: int = 1, title: str = "",
    marks: Callable[[Picture], Picture] | None = None,
) -> Picture:
    """Lay out Supplementary Video 5 and Figure 4b: frame, events, DoLP; traces below.

    Parameters
    ----------
    held : PolarFrame
        From ``frames``; its S0 is shown.
    events : ndarray of uint8, shape (H, W, 3)
        Event window; see `events_on`.
    fused : PolarFrame
        Its DoLP is shown.
    below : ndarray of uint8, shape (H', W', 3)
        Traces; see `chart`.
    grey : callable
        Tone curve of S0.
    top : float
        DoLP of the brightest colour.
    scale : int
        Picture pixels per pixel.
    title : str
        One line over all.
    marks : callable, optional
        Draws the regions on the DoLP picture.

    Returns
    -------
    ndarray of uint8, shape (H'', W'', 3)
        BGR of even size.
    """
    scale = whole_number("scale", scale, 1, 64)
    colour = dolp_bgr(fused.dolp, fused.valid, top=top).repeat(
        scale, axis=0).repeat(scale, axis=1)
    name = str(fused.provenance.get("method", "fused"))
    style = DARK.sized(colour.shape[1])
    upper = tile([
        panel(grey(held.s0, held.valid), "frame: S0", scale=scale, style=style),
        panel(events, "events: ON white, OFF black", scale=scale, style=style),
        panel(colour if marks is None else marks(colour), f"{name}: DoLP",
              legend="dolp", end=f"{top:.3g}", style=style)],
        columns=3, title=title, style=style)
    return even(stack((upper, below)))


def _to_height(picture: Picture, height: int, scale: int) -> Picture:
    """Resize a picture of another camera to a height, by nearest neighbours."""
    if picture.shape[0] == height:
        return picture.repeat(scale, axis=0).repeat(scale, axis=1)
    tall = height * scale
    wide = round(picture.shape[1] * tall / picture.shape[0])
    rows = (np.arange(tall) * picture.shape[0]) // tall
    columns = (np.arange(wide) * picture.shape[1]) // wide
    return np.asarray(picture[rows][:, columns], np.uint8)
