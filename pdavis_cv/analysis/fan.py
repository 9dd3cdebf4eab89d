"""Measure the polarizer angles of the sectors of a rotating wheel."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._checks import (
    MOST_ANGLE,
    MOST_RPM,
    MOST_SIDE,
    place,
    plain,
    real_number,
    whole_number,
)
from pdavis_cv.analysis.traces import pixels_per_sample, region_statistics
from pdavis_cv.events import FAR
from pdavis_cv.mosaic import HALF_SIZE
from pdavis_cv.polarimetry import PolarFrame


@dataclass(frozen=True, kw_only=True)
class Wheel:
    """Equal sectors around an axis, turning at a constant speed.

    Angles are counter-clockwise as displayed, 0 to the right.

    Parameters
    ----------
    centre : (float, float)
        x and y of the axis in sensor pixels, within 65,536 of 0; (0, 0) is the middle
        of the top left pixel.
    radius, hub : float
        Outer and inner radius of the measured region, pixels, at most 65,536.
    sectors : int
        Number of sectors, 1 to 127: labels are int8.
    rpm : float
        Turns per minute, within 3e7 of 0, half a turn per microsecond; 0 for a wheel at
        rest.
    start_angle : float
        Angle of the middle of sector 0 at ``origin_us``, radians, within 1e6 of 0.
    origin_us : int
        Time of ``start_angle``, within 2**61 us of 0.
    margin : float
        Fraction of a sector's angle that is left out at each edge.

    Raises
    ------
    ValueError
        If a number is impossible; the message names it.
    """

    centre: tuple[float, float]
    radius: float
    hub: float = 0.0
    sectors: int = 6
    rpm: float = 0.0
    start_angle: float = 0.0
    origin_us: int = 0
    margin: float = 0.15

    def __post_init__(self) -> None:
        radius, hub, rpm, angle, margin = (real_number(each) for each in (
            self.radius, self.hub, self.rpm, self.start_angle, self.margin))
        for name, holds, rule in (
                ("hub", 0 <= hub <= MOST_SIDE, f"lie in 0..{MOST_SIDE}"),
                ("radius", hub < radius <= MOST_SIDE,
                 f"exceed hub = {hub:g} and be at most {MOST_SIDE}"),
                ("margin", 0 <= margin < 0.5, "lie in 0..0.5"),
                ("rpm", abs(rpm) <= MOST_RPM, f"lie within {MOST_RPM:g} of 0"),
                ("start_angle", abs(angle) <= MOST_ANGLE,
                 f"lie within {MOST_ANGLE:g} of 0")):
            if not holds:
                raise ValueError(f"{name} must {rule}, got {getattr(self, name)!r}")
        # Python's numbers, since NumPy's small ones overflow.
        for name, value in {
                "centre": place("centre", self.centre), "radius": plain(self.radius),
                "hub": plain(self.hub), "rpm": plain(self.rpm),
                "start_angle": plain(self.start_angle), "margin": plain(self.margin),
                "sectors": whole_number(
                    "sectors", self.sectors, 1, np.iinfo(np.int8).max),
                "origin_us": whole_number(
                    "origin_us", self.origin_us, -FAR, FAR)}.items():
            object.__setattr__(self, name, value)

    def turned(self, t_us: int) -> float:
        """Return the angle of the middle of sector 0 at a time, radians."""
        return self.start_angle + 2 * np.pi * self.rpm / 60e6 * (t_us - self.origin_us)

    def labels(
        self, t_us: int, shape: tuple[int, int], *, origin: tuple[int, int] = (0, 0),
        scale: int = 1,
    ) -> NDArray[np.int8]:
        """Return the sector of each pixel, -1 outside all sectors.

        Parameters
        ----------
        t_us : int
            Time.
        shape : (int, int)
            (height, width) of the image.
        origin : (int, int)
            (x, y) of its top left corner on the sensor.
        scale : int
            Sensor pixels per image pixel; 2 for super-pixel images.

        Returns
        -------
        ndarray of int8, shape (H, W)
        """
        y, x = np.mgrid[:shape[0], :shape[1]]
        across = (x + 0.5) * scale - 0.5 + origin[0] - self.centre[0]
        up = self.centre[1] - ((y + 0.5) * scale - 0.5 + origin[1])
        r = np.hypot(across, up)
        place = (np.arctan2(up, across) - self.turned(t_us)) * (
            self.sectors / (2 * np.pi))
        nearest = np.rint(place)
        inside = ((r >= self.hub) & (r <= self.radius)
                  & (np.abs(place - nearest) <= 0.5 - self.margin))
        return np.where(inside, np.mod(nearest, self.sectors), -1).astype(np.int8)

    def measure(self, frame: PolarFrame) -> NDArray[Any]:
        """Return the statistics of each sector in one image.

        Parameters
        ----------
        frame : PolarFrame
            With a time.

        Returns
        -------
        ndarray of TRACE_DTYPE, shape (sectors,)
            ``aop`` is relative to the image; minus `turned`, relative to the wheel.

        Raises
        ------
        ValueError
            If the image has no time, or the wheel leaves it.
        """
        if frame.t_us is None:
            raise ValueError("frame must have a time")
        demosaic = str(frame.provenance.get("demosaic"))
        scale = 2 if demosaic in HALF_SIZE else 1
        left, top = (int(v) for v in frame.provenance.get("roi", (0, 0))[:2])
        height, width = (side * scale for side in frame.shape)
        x, y = self.centre[0] - left, self.centre[1] - top
        if (x - self.radius < -1 or y - self.radius < -1
                or x + self.radius > width or y + self.radius > height):
            raise ValueError(
                f"the wheel (centre {self.centre}, radius {self.radius:g}) must lie "
                f"inside the {width}x{height} image")
        labels = self.labels(frame.t_us, frame.shape, origin=(left, top), scale=scale)
        stokes = np.stack((frame.s0, frame.s1, frame.s2))
        rows = []
        for k in range(self.sectors):
            mask = labels == k
            rows.append(region_statistics(
                frame.quad[:, mask], stokes[:, mask], frame.valid[mask],
                pixels_per_sample=pixels_per_sample(demosaic)))
            rows[-1]["t_us"] = frame.t_us
        return np.array(rows)


@dataclass(frozen=True)
class SectorSummary:
    """One sector over time; angles in radians.

    Parameters
    ----------
    sector : int
        Number.
    images : int
        Number of images that show it.
    aop : float
        Mean angle relative to the wheel, [0, pi).
    aop_sd : float
        Standard deviation of the images' means over time.
    aop_se : float
        Standard error of ``aop``.
    pixel_sd : float
        Mean standard deviation over the pixels of an image.
    error : float
        Deviation of ``aop`` from equal spacing, after subtraction of a common offset.
    dolp : float
        Mean DoLP.
    """

    sector: int
    images: int
    aop: float
    aop_sd: float
    aop_se: float
    pixel_sd: float
    error: float
    dolp: float


def summarise_sectors(
    wheel: Wheel, rows: Sequence[NDArray[Any]], *, spacing: float | None = None
) -> list[SectorSummary]:
    """Summarise the results of `Wheel.measure` over time.

    Parameters
    ----------
    wheel : Wheel
        The wheel.
    rows : sequence of ndarray of TRACE_DTYPE, shape (sectors,)
        One per image.
    spacing : float, optional
        Angle between the polarizers of adjacent sectors, radians; default: pi divided
        by the number of sectors.

    Returns
    -------
    list of SectorSummary
        One per sector; NaN for one that no image shows.

    Raises
    ------
    ValueError
        If there is no image.
    """
    if not len(rows):
        raise ValueError("rows must hold at least one image")
    table = np.array(rows)
    step = np.pi / wheel.sectors if spacing is None else spacing
    turned = np.array([[wheel.turned(int(t))] for t in table["t_us"][:, 0]])
    unit = np.exp(2j * (table["aop"] - turned))
    seen = np.isfinite(unit)
    count = seen.sum(0)
    mean = np.where(seen, unit, 0).sum(0) / np.maximum(count, 1)
    mean[count == 0] = np.nan
    length = np.minimum(np.abs(mean), 1)
    with np.errstate(divide="ignore"):
        sd = np.sqrt(-2 * np.log(length)) / 2
    known = count > 0
    relative = mean / np.abs(mean) * np.exp(-2j * step * np.arange(wheel.sectors))
    common = relative[known].mean() if known.any() else 1.0
    error = np.angle(relative / common) / 2
    result = []
    for k in range(wheel.sectors):
        angle = float(np.mod(np.angle(mean[k]) / 2, np.pi)) if known[k] else np.nan
        part = table[seen[:, k], k]
        pixel_sd = float(part["aop_sd"].mean()) if len(part) else np.nan
        dolp = float(part["dolp"].mean()) if len(part) else np.nan
        result.append(SectorSummary(
            k, int(count[k]), 0.0 if angle >= np.pi else angle, float(sd[k]),
            float(sd[k] / np.sqrt(max(count[k], 1))), pixel_sd, float(error[k]), dolp))
    return result
