"""A DAVIS346 camera through neuromorphic-drivers, which passes on its raw words.

The driver sets registers and transfers bytes.  The words are decoded in this library,
because drivers clamp dark pixels at 0 and hide the two reads of a frame.  This module
has never run on a camera: it follows the driver's types and sources.
"""
from __future__ import annotations

import itertools
import time
from collections.abc import Mapping
from typing import Any

from pdavis_cv._packages import package
from pdavis_cv.errors import DeviceError
from pdavis_cv.live.base import HEARTBEAT_S
from pdavis_cv.recording.base import RecordingInfo
from pdavis_cv.recording.davis import DAVIS346_SIZE, Orientation
from pdavis_cv.recording.davis_trace import Transfer
from pdavis_cv.sensor import Sensor

BIASES = (
    "localbufbn", "padfollbn", "diffbn", "onbn", "offbn", "pixinvbn", "prbp", "prsfbp",
    "refrbp", "readoutbufbp", "apsrosfbn", "adccompbp", "colsellowbn", "dacbufbp",
    "lcoltimeoutbn", "aepdbn", "aepuxbp", "aepuybp", "ifrefrbn", "ifthrbn",
    "biasbuffer")
SETTINGS = ("exposure_us", "frame_interval_us", *BIASES)
"""Settings of the camera: times of frames in us, and biases as the driver's codes of
their currents, 0 to 2040 (a factor of about 8 every 255)."""
MOST_BIAS = 2040
LONGEST_US = 1_000_000
_NAME = "INIVATION_DAVIS346"


def _driver() -> Any:
    return package("neuromorphic_drivers", "a camera needs a package: pip install "
                   "neuromorphic-drivers")


def listed() -> list[dict[str, str | None]]:
    """Return the DAVIS346 cameras that are plugged in.

    Each has ``name``, ``serial``, ``connection`` and ``error``, the reason why a camera
    cannot be opened.
    """
    driver = _driver()
    try:
        found = driver.list_devices()
    except RuntimeError as error:
        raise DeviceError(f"usb: cannot be asked: {error}") from error
    return [{"name": one.name.value, "serial": one.serial,
             "connection": one.connection.value, "error": one.error}
            for one in found if one.name.name == _NAME]


def address_of(index: int) -> str:
    """Return the address of a camera by its number, as cv2 counts them."""
    found = listed()
    if not 0 <= index < len(found):
        raise DeviceError(
            f"there is no camera {index}: {len(found)} cameras are plugged in")
    return f"usb:{found[index]['serial'] or ''}"


class Davis346:
    """A DAVIS346 camera, which gives the words that it sends.

    The background-activity filter, which the driver switches on by default, is off: it
    compares a pixel with its neighbours, which lie behind other polarizers.  Without a
    serial number, it is the first camera found; for other `SETTINGS` than the given
    ones, the driver's defaults hold.
    """

    def __init__(self, serial: str | None, settings: Mapping[str, int]) -> None:
        driver = _driver()
        self._configuration = driver.inivation_davis346.Configuration()
        self._configuration.activity_filter.mask_isolated_enable = False
        self._apply(settings)
        try:
            self._device = driver.open(
                configuration=self._configuration, iterator_timeout=HEARTBEAT_S,
                raw=True, serial=serial)
        except RuntimeError as error:
            which = "camera" if serial is None else f"camera {serial}"
            raise DeviceError(
                f"usb: no {which} could be opened: {error}; see pdavis devices, and "
                "docs/live.md for rights and drivers") from error
        mounted = self._device.orientation()
        self.orientation = Orientation(
            events_turned=mounted.dvs_invert_xy, frames_flipped_x=mounted.aps_flip_x,
            frames_flipped_y=mounted.aps_flip_y, frames_turned=mounted.aps_invert_xy,
            imu_flipped=(mounted.imu_flip_x, mounted.imu_flip_y, mounted.imu_flip_z),
            imu_type=self._device.imu_type())
        found = self._device.serial()
        self.info = RecordingInfo(
            format="DAVIS346 over USB", sensor_size=DAVIS346_SIZE,
            camera=f"DAVIS346 {found}", serial=found,
            exposure_us=self.settings["exposure_us"], sensor=Sensor.DAVIS346,
            full_scale_dn=Sensor.DAVIS346.full_scale_dn, frame_times="time stamps",
            header={"settings": dict(self.settings),
                    "background_activity_filter": False})

    def _apply(self, settings: Mapping[str, int]) -> None:
        for name, value in settings.items():
            if name not in SETTINGS:
                raise ValueError(
                    f"there is no setting {name!r}; there are {', '.join(SETTINGS)}")
            most = LONGEST_US if name.endswith("_us") else MOST_BIAS
            if not 0 <= value <= most:
                raise ValueError(f"{name} must lie in 0..{most}, got {value}")
        for name, value in settings.items():
            owner = (self._configuration if name.endswith("_us")
                     else self._configuration.biases)
            setattr(owner, name, value)

    @property
    def settings(self) -> Mapping[str, int]:
        """Settings passed to the driver, as they cannot be read from the camera."""
        configuration = self._configuration
        return {"exposure_us": configuration.exposure_us,
                "frame_interval_us": configuration.frame_interval_us,
                **{name: getattr(configuration.biases, name) for name in BIASES}}

    def set(self, **settings: int) -> None:
        """Change settings; a running camera applies them within some frames."""
        self._apply(settings)
        try:
            self._device.update_configuration(self._configuration)
        except RuntimeError as error:
            raise self._gone(error) from error

    def read(self, timeout_s: float) -> list[Transfer] | None:
        """Return what has arrived; waits for `HEARTBEAT_S`, whatever `timeout_s`."""
        try:
            status, data = next(self._device)
        except StopIteration:
            return None
        except RuntimeError as error:
            raise self._gone(error) from error
        if status.ring is None or not data:
            return []
        # The driver reports Unix time; the host's monotonic clock never jumps.
        host_s = time.monotonic() - (status.system_time - status.ring.system_time)
        gaps = [at for at in status.ring.overflow_indices or () if at < len(data)]
        edges = [0, *(at for at in gaps if at > 0), len(data)]
        return [Transfer(data[low:high], host_s, low in gaps)
                for low, high in itertools.pairwise(edges)]

    def _gone(self, error: Exception) -> DeviceError:
        return DeviceError(
            f"{self.info.camera}: the device is gone: plug it in and open it again "
            f"({error})")

    def close(self) -> None:
        """Stop the camera."""
        self._device.close()
