"""Traces: polarization of regions over time, each value with its error."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._checks import fitting, floats, planes, some
from pdavis_cv._types import Records
from pdavis_cv.analysis.optics import subtract_background
from pdavis_cv.analysis.roi import Roi
from pdavis_cv.mosaic import HALF_SIZE
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.recording.base import Recording

TRACE_DTYPE = np.dtype([
    ("t_us", "<i8"), ("pixels", "<i8"),
    ("i0", "<f8"), ("i45", "<f8"), ("i90", "<f8"), ("i135", "<f8"),
    ("s0", "<f8"), ("s0_se", "<f8"), ("s1", "<f8"), ("s2", "<f8"),
    ("dolp", "<f8"), ("dolp_se", "<f8"), ("dolp_sd", "<f8"),
    ("aop", "<f8"), ("aop_se", "<f8"), ("aop_sd", "<f8"),
    ("event_rate", "<f8"), ("event_rate_se", "<f8")])
"""One row per time: intensities and S0 in DN per ms, AoP in radians, events per
second; ``pixels`` counts the usable ones, ``_se`` are standard errors of the region's
value, ``_sd`` spreads over its pixels (circular for AoP).  NaN = not known."""

# How many times the variance of a region's mean exceeds that of as many independent
# pixels.  Bilinear: a pixel has 9/16 of a sample's variance on average, and the mean
# rests on a quarter as many samples as it has pixels.  Binned: weights (3, 1) / 4 along
# both axes leave (5 / 8)^2.  Guided: measured, even light of DoLP .1 and .3 with white
# noise (2.9 to 3.2, 11.7 to 13.4); S1 and S2 are fitted in a window.
_PIXELS_PER_SAMPLE = {
    "bilinear": (64 / 9,) * 3, "superpixel": (1.0,) * 3, "binned": (64 / 25,) * 3,
    "guided": (3.0, 12.5, 12.5)}


def pixels_per_sample(demosaic: str) -> tuple[float, float, float]:
    """Return the number of pixels of S0, S1 and S2 per independent sample."""
    return _PIXELS_PER_SAMPLE.get(demosaic, (1.0, 1.0, 1.0))


@dataclass(frozen=True, eq=False)
class Traces:
    """Traces of several regions.

    Parameters
    ----------
    rois : tuple of Roi
        The regions.
    table : ndarray of TRACE_DTYPE, shape (R, T)
        One row per region.
    provenance : mapping of str to object
        Provenance of the images.
    """

    rois: tuple[Roi, ...]
    table: Records
    provenance: dict[str, Any]

    @property
    def t_us(self) -> NDArray[np.int64]:
        """Times, shape (T,)."""
        times: NDArray[np.int64] = self.table["t_us"][0]
        return times


def region_statistics(
    quad: ArrayLike, stokes: ArrayLike, valid: NDArray[np.bool_], *,
    estimate: str = "stokes",
    pixels_per_sample: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> NDArray[Any]:
    """Summarise the pixels of one region in one image.

    Parameters
    ----------
    quad : array_like, shape (4, N)
        I0, I45, I90, I135 of the pixels.
    stokes : array_like, shape (3, N)
        S0, S1, S2.
    valid : ndarray of bool, shape (N,)
        True = usable.
    estimate : {"stokes", "pixels"}
        Whether DoLP and AoP are those of the mean Stokes vector, or the mean and
        circular mean over pixels.  The mean of DoLP is biased upward by noise.
    pixels_per_sample : (float, float, float)
        Number of pixels of S0, S1 and S2 per independent sample.

    Returns
    -------
    ndarray of TRACE_DTYPE, shape ()
        Without time and events.  Standard errors follow from the scatter over the
        region; NaN if fewer than two pixels are usable.

    Raises
    ------
    ValueError
        If ``estimate`` is unknown.
    """
    if estimate not in ("stokes", "pixels"):
        raise ValueError(f"estimate must be 'stokes' or 'pixels', got {estimate!r}")
    s, intensity = planes("stokes", stokes, 3), planes("quad", quad, 4)
    valid = fitting("valid", np.asarray(valid, np.bool_), s.shape[1:])
    fitting("quad", intensity, (4, *valid.shape))
    s, intensity = s[:, valid], intensity[:, valid]
    usable = np.isfinite(s).all(0) & (s[0] > 0)
    s, intensity = s[:, usable], intensity[:, usable]
    n = s.shape[1]
    row = np.zeros((), TRACE_DTYPE)
    for name in TRACE_DTYPE.names or ():
        if TRACE_DTYPE[name].kind == "f":
            row[name] = np.nan
    row["pixels"] = n
    if n == 0:
        return row
    row["i0"], row["i45"], row["i90"], row["i135"] = intensity.mean(1)
    mean = s.mean(1)
    row["s0"], row["s1"], row["s2"] = mean
    share = np.sqrt(pixels_per_sample)
    polarized = np.hypot(s[1], s[2])
    dolp = polarized / s[0]
    unit = (s[1] + 1j * s[2]) / np.where(polarized > 0, polarized, 1)
    resultant = min(float(np.abs(unit.mean())), 1.0)
    spread = (float(np.sqrt(-2 * np.log(resultant)) / 2) if resultant > 0 else np.inf)
    row["dolp_sd"] = np.std(dolp, ddof=1) if n > 1 else np.nan
    row["aop_sd"] = spread
    if estimate == "pixels":
        row["dolp"] = dolp.mean()
        row["aop"] = _axial(float(unit.mean().imag), float(unit.mean().real))
        if n > 1:
            row["s0_se"] = np.std(s[0], ddof=1) * share[0] / np.sqrt(n)
            row["dolp_se"] = row["dolp_sd"] * share[1] / np.sqrt(n)
            row["aop_se"] = spread * share[1] / np.sqrt(n)
        return row
    length = float(np.hypot(mean[1], mean[2]))
    row["dolp"] = length / mean[0]
    row["aop"] = _axial(float(mean[2]), float(mean[1]))
    if n > 1:
        covariance = np.cov(s) * np.outer(share, share) / n
        row["s0_se"] = np.sqrt(covariance[0, 0])
        if length > 0:
            along = np.array(
                [-row["dolp"], mean[1] / length, mean[2] / length]) / mean[0]
            across = np.array([0, -mean[2], mean[1]]) / (2 * length ** 2)
            row["dolp_se"] = np.sqrt(max(along @ covariance @ along, 0))
            row["aop_se"] = np.sqrt(max(across @ covariance @ across, 0))
    return row


def _axial(s2: float, s1: float) -> float:
    angle = float(np.mod(np.arctan2(s2, s1) / 2, np.pi))
    return 0.0 if angle >= np.pi else angle


class TraceRecorder:
    """Collect traces of regions, image by image.

    Parameters
    ----------
    rois : sequence of Roi
        Regions in sensor pixels.  For images of a part of the sensor and super-pixel
        images, the provenance gives the relation to sensor pixels.
    estimate : {"stokes", "pixels"}
        See `region_statistics`.
    background : ndarray, shape (3, H, W), optional
        S0, S1, S2 without a sample, to be subtracted.

    Raises
    ------
    ValueError
        If there is no region or ``estimate`` is another word.
    """

    def __init__(
        self, rois: Sequence[Roi], *, estimate: str = "stokes",
        background: ArrayLike | None = None,
    ) -> None:
        if estimate not in ("stokes", "pixels"):
            raise ValueError(f"estimate must be 'stokes' or 'pixels', got {estimate!r}")
        self.rois, self.estimate = tuple(some("rois", rois)), estimate
        self._background = None if background is None else np.asarray(background)
        self._rows: list[list[NDArray[Any]]] = []
        self._places: list[tuple[slice, slice, NDArray[np.bool_]]] = []
        self._shape: tuple[int, ...] = ()
        self._provenance: dict[str, Any] = {}
        self._per_sample = pixels_per_sample("")

    def add(self, frame: PolarFrame) -> None:
        """Add an image.

        Parameters
        ----------
        frame : PolarFrame
            From `fuse`; all images must have the same shape.

        Raises
        ------
        ValueError
            If a region does not fit the images, or the image has no time.
        """
        if frame.t_us is None:
            raise ValueError("frame must have a time")
        if not self._places:
            self._begin(frame)
        if frame.valid.shape != self._shape:
            raise ValueError(
                f"frame must have the first one's shape {self._shape}, got "
                f"{frame.valid.shape}")
        rows = []
        for top, left, mask in self._places:
            stokes = np.stack([plane[top, left][mask] for plane in (
                frame.s0, frame.s1, frame.s2)]).astype(np.float64)
            if self._background is not None:
                stokes = subtract_background(
                    stokes, self._background[:, top, left][:, mask])
            row = region_statistics(
                frame.quad[:, top, left][:, mask], stokes, frame.valid[top, left][mask],
                estimate=self.estimate, pixels_per_sample=self._per_sample)
            row["t_us"] = frame.t_us
            rows.append(row)
        self._rows.append(rows)

    def _begin(self, frame: PolarFrame) -> None:
        self._provenance = dict(frame.provenance)
        demosaic = str(self._provenance.get("demosaic"))
        self._per_sample = pixels_per_sample(demosaic)
        x, y = (int(v) for v in self._provenance.get("roi", (0, 0))[:2])
        self._shape = frame.valid.shape
        masks = [roi.mask((self._shape[0], self._shape[1]), origin=(x, y),
                          scale=2 if demosaic in HALF_SIZE else 1)
                 for roi in self.rois]
        if (self._background is not None
                and self._background.shape != (3, *self._shape)):
            raise ValueError(
                f"background must be {(3, *self._shape)}, got {self._background.shape}")
        for mask in masks:
            rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
            top = slice(int(rows[0]), int(rows[-1]) + 1)
            left = slice(int(columns[0]), int(columns[-1]) + 1)
            self._places.append((top, left, mask[top, left]))

    @property
    def count(self) -> int:
        """Number of images so far."""
        return len(self._rows)

    def traces(self, recording: Recording | None = None) -> Traces:
        """Return the traces so far.

        Parameters
        ----------
        recording : Recording, optional
            Adds event rates in the interval before each image.

        Returns
        -------
        Traces

        Raises
        ------
        ValueError
            If no image was taken in.
        """
        if not self._rows:
            raise ValueError("no image was added, so there is no trace")
        table = np.array(self._rows, TRACE_DTYPE).T.copy()
        if recording is not None and table.shape[1] > 1:
            t = table["t_us"][0]
            edges = np.concatenate(([2 * t[0] - t[1]], t))
            counts = event_counts(recording, self.rois, edges)
            seconds = np.diff(edges) / 1e6
            table["event_rate"] = counts / seconds
            # Of a Poisson process; 1 for none seen, as its 68 % limit.
            table["event_rate_se"] = np.sqrt(np.maximum(counts, 1)) / seconds
        return Traces(self.rois, table, self._provenance)


def event_counts(
    recording: Recording, rois: Sequence[Roi], edges_us: ArrayLike
) -> NDArray[np.int64]:
    """Count the events of each region between times.

    Parameters
    ----------
    recording : Recording
        Read once, from the first to the last edge.
    rois : sequence of Roi
        In sensor pixels.
    edges_us : array_like of int, shape (T + 1,)
        Increasing; intervals are half-open.

    Returns
    -------
    ndarray of int64, shape (R, T)

    Raises
    ------
    ValueError
        If there is no region, or the edges do not increase.
    """
    edges = floats("edges_us", edges_us, np.int64)
    if edges.ndim != 1 or len(edges) < 2 or np.any(np.diff(edges) <= 0):
        raise ValueError("edges_us must be two or more increasing times")
    masks = [roi.mask(recording.info.sensor_size) for roi in some("rois", rois)]
    counts = np.zeros((len(masks), len(edges) - 1), np.int64)
    for packet in recording.packets(int(edges[0]), int(edges[-1])):
        events = packet.events
        if not len(events):
            continue
        bins = np.searchsorted(edges, events["t"], side="right") - 1
        for mask, row in zip(masks, counts, strict=True):
            inside = bins[mask[events["y"], events["x"]]]
            row += np.bincount(inside, minlength=len(row))
    return counts


def axial_difference(a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    """Return a - b of two axial angles in radians, in [-pi/2, pi/2)."""
    a, b = floats("a", a), floats("b", b)
    difference = a - fitting("b", b, a.shape) if a.ndim >= b.ndim else (
        fitting("a", a, b.shape) - b)
    return np.asarray((difference + np.pi / 2) % np.pi - np.pi / 2)
