"""Overlays: events, masks of reliability, text, a scale bar."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._checks import MOST_SIDE, positive, sensor_shape, whole_number
from pdavis_cv.events import as_events
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.render.colours import FULL_COLOUR_DOLP, Picture, checked_picture, fade
from pdavis_cv.render.legends import DARK, caption, text_width

ON, OFF = (255, 255, 255), (0, 0, 0)

HIDDEN_SIGMA_DEG = 20.0
"""Standard deviation of AoP above which a faded picture hides it; of a random angle it
is 52 degrees."""


def events_on(
    picture: Picture | tuple[int, int], events: Any, *,
    origin: tuple[int, int] = (0, 0), step: int = 64,
    colours: tuple[Sequence[int], Sequence[int]] = (ON, OFF),
) -> Picture:
    """Show events over a picture, ON towards white and OFF towards black.

    A pixel with n more ON than OFF events moves towards the colour of ON by the
    fraction ``min(1, n * step / 255)``, and correspondingly for OFF.

    Parameters
    ----------
    picture : ndarray of uint8, shape (H, W, 3), or (H, W)
        Background; a size means mid-grey, as in the paper's figure 4.
    events : structured array
        Events as accepted by `as_events`, in sensor pixels; those outside are ignored.
    origin : (int, int)
        (x, y) of the picture's top left corner on the sensor.
    step : int
        Grey values per event.
    colours : (sequence of int, sequence of int)
        BGR of ON and of OFF.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        A new picture.
    """
    if isinstance(picture, tuple):
        picture = np.full((*sensor_shape(picture, "picture"), 3), 128, np.uint8)
    if not isinstance(picture, np.ndarray) or picture.ndim not in (2, 3):
        raise TypeError(
            f"picture must be an image or (height, width), got {picture!r:.60}")
    height, width = picture.shape[:2]
    if not (isinstance(origin, tuple) and len(origin) == 2):
        raise ValueError(f"origin must be (x, y), got {origin!r:.60}")
    origin = (whole_number("origin", origin[0], -MOST_SIDE, MOST_SIDE),
              whole_number("origin", origin[1], -MOST_SIDE, MOST_SIDE))
    found = as_events(events)
    x = found["x"].astype(np.int64) - origin[0]
    y = found["y"].astype(np.int64) - origin[1]
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    sign = np.where(found["p"][inside] > 0, 1.0, -1.0)
    net = np.bincount(y[inside] * width + x[inside], sign, height * width)
    net = net.reshape(height, width)
    share = np.minimum(np.abs(net) * (step / 255), 1)[..., None]
    target = np.where((net > 0)[..., None], np.array(colours[0]), np.array(colours[1]))
    mixed = picture + share * (target - picture.astype(np.float64))
    result: Picture = np.rint(mixed).astype(np.uint8)
    return result


def reliable(
    frame: PolarFrame, *, least_dolp: float | None = None,
    most_sigma_deg: float | None = None,
) -> NDArray[np.bool_]:
    """Return the pixels whose angle is reliable.

    Parameters
    ----------
    frame : PolarFrame
        The image.
    least_dolp : float, optional
        Smallest DoLP, as in the paper.
    most_sigma_deg : float, optional
        Largest standard deviation of AoP, degrees.

    Returns
    -------
    ndarray of bool, shape (H, W)
        A subset of ``frame.valid``.

    Raises
    ------
    ValueError
        If `most_sigma_deg` is given and the method has no variance.
    """
    good = frame.valid.copy()
    if least_dolp is not None:
        good &= frame.dolp >= least_dolp
    if most_sigma_deg is not None:
        if frame.sigma_aop is None:
            raise ValueError(
                "most_sigma_deg needs a method that knows its variance, such as kalman")
        good &= frame.sigma_aop <= np.deg2rad(most_sigma_deg)
    return good


def known_aop(frame: PolarFrame) -> NDArray[np.bool_]:
    """Return where an image's AoP is not stated to be noise, shape (H, W).

    It is if its method states a standard deviation above `HIDDEN_SIGMA_DEG`.
    """
    if frame.sigma_aop is None:
        return np.ones(frame.shape, np.bool_)
    return np.asarray(frame.sigma_aop <= np.deg2rad(HIDDEN_SIGMA_DEG))


def fade_aop(
    picture: Picture, frame: PolarFrame, *, low: float = 0.0,
    top: float = FULL_COLOUR_DOLP, ground: int = 0,
) -> None:
    """Fade the picture of an image's AoP in place where the angle means little.

    Parameters
    ----------
    picture : ndarray of uint8, shape (H, W, 3)
        As `aop_bgr` draws it; pixels that are not valid stay as they are.
    frame : PolarFrame
        Its DoLP sets the colour's share, which is 0 where AoP is not `known_aop`.
    low, top : float
        DoLP of no colour and of full colour.
    ground : int
        Grey value to fade to, 0..255.
    """
    weight = frame.dolp - np.float32(low)
    if frame.sigma_aop is not None:
        weight = np.where(known_aop(frame), weight, np.float32(0))
    fade(picture, weight, frame.valid, top=top - low, ground=ground)


def scale_bar(picture: Picture, pixel_um: float, *, scale: int = 1) -> Picture:
    """Draw a bar of a round length, at most a third of the width, bottom right.

    Parameters
    ----------
    picture : ndarray of uint8, shape (H, W, 3)
        BGR.
    pixel_um : float
        Size of a sensor pixel in the object, micrometres.
    scale : int
        Picture pixels per sensor pixel.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        A new picture.

    Raises
    ------
    ValueError
        If ``pixel_um`` is not positive.
    """
    pixel_um = positive("pixel_um", pixel_um)
    scale = whole_number("scale", scale, 1, 64)
    picture = np.array(checked_picture(picture), order="C")
    height, width = picture.shape[:2]
    zoom = DARK.sized(width).zoom
    longest = width / 3 / scale * pixel_um
    power = 10.0 ** np.floor(np.log10(longest))
    length = next(m * power for m in (5, 2, 1) if m * power <= longest)
    pixels = max(1, round(length / pixel_um * scale))
    right, bottom = width - 8 * zoom, height - 8 * zoom
    text = f"{length:g} um" if length < 1000 else f"{length / 1000:g} mm"
    room = text_width(text, zoom)
    left = max(0, min(right - (pixels + room) // 2, width - room - 2 * zoom))
    wide = max(pixels, room) + 8 * zoom
    ground = picture[max(0, bottom - 24 * zoom):, max(0, right - wide):]
    ground //= 3    # so that bar and text are visible on any colour
    picture[bottom - 3 * zoom:bottom, right - pixels:right] = 235
    caption(picture, text, left, bottom - 8 * zoom, zoom=zoom)
    return picture
