"""One specimen of a camera: its parts, and the parameters of its pixels."""
from __future__ import annotations

from typing import Any

from pdavis_cv._checks import MOST_SIDE, place, plain, sensor_shape, whole_number
from pdavis_cv.recording.base import RecordingInfo
from pdavis_cv.sensor import Layout, Sensor
from pdavis_cv.simulation.aps import ApsPixel
from pdavis_cv.simulation.bus import Bus
from pdavis_cv.simulation.checks import instance, require
from pdavis_cv.simulation.dvs import DvsPixel
from pdavis_cv.simulation.faults import Faults
from pdavis_cv.simulation.optics import Optics
from pdavis_cv.simulation.scenes import FloatArray


class Specimen:
    """What is constant from one recording of a camera to the next; see `Camera`."""

    def __init__(
        self, *, optics: Optics | None = None, dvs: DvsPixel | None = None,
        aps: ApsPixel | None = None, bus: Bus | None = None,
        faults: Faults | None = None, seed: int = 0,
        size: tuple[int, int] = (12, 12), origin: tuple[int, int] | None = None,
        sensor: Sensor = Sensor.PDAVIS, name: str = "simulated",
    ) -> None:
        instance(Sensor)("sensor", sensor)
        size = height, width = sensor_shape(size, "size")
        if origin is None:
            origin = ((sensor.size[0] - height) // 4 * 2,
                      (sensor.size[1] - width) // 4 * 2)
        row, column = place("origin", origin)
        origin = (whole_number("origin", row, -MOST_SIDE, MOST_SIDE),
                  whole_number("origin", column, -MOST_SIDE, MOST_SIDE))
        require("origin", origin,
                0 <= origin[0] <= sensor.size[0] - height
                and 0 <= origin[1] <= sensor.size[1] - width,
                f"leave {height} rows and {width} columns of the {sensor.name}'s "
                f"{sensor.size[0]} and {sensor.size[1]}")
        seed = plain(seed)
        require("seed", seed, isinstance(seed, int) and seed >= 0,
                "be an integer of at least 0")
        for part, one, kind in (
                ("optics", optics, Optics), ("dvs", dvs, DvsPixel),
                ("aps", aps, ApsPixel), ("bus", bus, Bus), ("faults", faults, Faults)):
            if one is not None:
                instance(kind)(part, one)
        require("dvs and aps", None, dvs is not None or aps is not None,
                "not both be None")
        self.faults = Faults() if faults is None else faults
        if aps is not None:
            require("frame_offset_us", self.faults.frame_offset_us,
                    self.faults.frame_offset_us <= aps.readout_us,
                    f"be at most the read-out time, {aps.readout_us} us")
        self.optics = Optics() if optics is None else optics
        self.dvs, self.aps, self.bus, self.seed = dvs, aps, bus, seed
        self.size, self.origin, self.sensor, self.name = size, origin, sensor, name
        self.maps: dict[str, FloatArray] = self.optics.maps(
            seed, size, origin, sensor.size)
        if dvs is not None:
            self.maps |= dvs.maps(seed, size, origin)
        if aps is not None:
            self.maps |= aps.maps(seed, size, origin)
        for array in self.maps.values():
            array.flags.writeable = False

    @property
    def layout(self) -> Layout:
        """Polarizer layout of the region."""
        return self.optics.layout.crop(self.origin[1], self.origin[0])

    def noise_seed(self, run: int) -> int:
        """Seed of the noise of one recording of this specimen."""
        return (self.seed * 1_000_003 + run * 7_919 + 1) % 2**64

    def info(self, stop_us: int) -> RecordingInfo:
        """Information on a recording of this camera."""
        aps = self.aps
        return RecordingInfo(
            format="simulation", sensor_size=self.size, writer="pdavis_cv",
            camera=self.name, serial=self.serial, sensor=self.sensor,
            layout=self.layout, start_us=0, stop_us=stop_us,
            exposure_us=None if aps is None else aps.exposure_us,
            full_scale_dn=None if aps is None else self.sensor.full_scale_dn)

    def exact_calibration(self) -> dict[str, Any]:
        """Return the specimen's true parameters, as arguments of `Calibration`.

        They are ``sensor_size``, ``chip``, ``serial``, ``layout``, ``analyser`` (H, W,
        3) and, where the camera has them, ``theta_on``, ``theta_off``, ``dark``.
        """
        names = {"theta_on": "theta_on", "theta_off": "theta_off", "dark": "dark_dn",
                 "analyser": "analyser"}
        return {"sensor_size": self.size, "chip": self.sensor.name,
                "serial": self.serial, "layout": self.layout,
                **{name: self.maps[key] for name, key in names.items()
                   if key in self.maps}}

    @property
    def serial(self) -> str:
        """Serial number of this specimen."""
        return f"{self.name}-{self.seed}"
