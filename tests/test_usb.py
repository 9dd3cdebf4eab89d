"""usb: what a camera sends is what its recording holds, and what can go wrong."""
import json
import sys
import types
from dataclasses import dataclass, field

import numpy as np
import pytest
from davis_words import SimulatedDavis346, unpaced, write_trace

import pdavis_cv
from pdavis_cv import (
    CAP_PDAVIS,
    DeviceError,
    Layout,
    VideoCapture,
    fuse,
    open_recording,
    open_source,
)
from pdavis_cv.live import Session, camera
from pdavis_cv.recording.davis import Orientation
from pdavis_cv.recording.davis_trace import Transfer
from pdavis_cv.simulation import Camera, RotatingPolarizer
from pdavis_cv.tools import devices

OPTIONS = {"layout": Layout.PDAVIS, "nominal_thresholds": (0.16, 0.18), "fps": 60}
METHODS = [{"method": name} for name in pdavis_cv.METHODS] + [
    {"method": "events", "offsets": "redundancy"}]


@pytest.fixture(scope="module")
def recording():
    made = Camera.preset("realistic", seed=4, size=(8, 8))
    return made.record(RotatingPolarizer(rpm=202.6, start_angle=0.3), 1.0)[0]


class Faulty:
    """A device between which and the host something goes wrong; times in s."""

    def __init__(self, device, *, unplug=9e9, reset=9e9, lose=(9e9, 9e9), dark=9e9):
        self.device, self.unplug, self.reset = device, unplug, reset
        self.lose, self.dark, self.missing = lose, dark, False
        self.info, self.orientation = device.info, device.orientation
        self.settings = device.settings

    def read(self, timeout_s):
        transfers = self.device.read(timeout_s)
        if transfers is None:
            return None
        one, = transfers
        if one.host_s >= self.unplug:
            raise DeviceError("the device is gone")
        if self.lose[0] <= one.host_s < self.lose[1]:
            self.missing = True
            return []
        words = np.frombuffer(one.data, "<u2")
        if one.host_s >= self.dark:     # time is all that is sent
            words = words[(words >> 12 == 7) | (words >> 15 == 1)]
        if one.host_s >= self.reset:
            self.reset = 9e9
            words = np.append(words, np.array([1, 0x8000], np.uint16))
            self.device._chunks.gi_frame.f_locals["self"].time_us = 0
        one = Transfer(words.astype("<u2").tobytes(), one.host_s, self.missing)
        self.missing = False
        return [one]

    def close(self):
        self.device.close()


def source(recording, **faults):
    return unpaced(Faulty(SimulatedDavis346(recording), **faults))


@pytest.mark.filterwarnings("ignore::UserWarning")     # long windows of a network
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_live_images_are_those_of_the_file_to_the_bit(recording, method):
    options = {**OPTIONS, **method}
    expected = list(fuse(recording, causal=True, **options))
    device = SimulatedDavis346(recording)
    with Session(unpaced(device), **options) as session:
        images = list(session)
        assert not session.problems
    for one, two in zip(images, expected, strict=True):
        assert (one.t_us, one.frame_us) == (two.t_us, two.frame_us)
        np.testing.assert_array_equal(one.quad, two.quad)
        np.testing.assert_array_equal(one.valid, two.valid)
    assert len(images) > 50


# ---- faults ----------------------------------------------------------------------


def test_a_camera_that_is_unplugged_is_told_after_the_last_image(recording):
    with Session(source(recording, unplug=0.5), **OPTIONS, method="cf") as session:
        images = []
        with pytest.raises(DeviceError, match="the device is gone"):
            images.extend(session)
        assert len(images) > 10


def test_lost_transfers_are_counted_and_time_goes_on(recording):
    with source(recording, lose=(0.40, 0.53)) as lossy:
        packets = list(lossy.packets())
    events = np.concatenate([packet.events for packet in packets])
    whole = recording.events()
    assert set(events.tolist()) <= set(whole.tolist())
    late = events["t"] >= 540_000
    np.testing.assert_array_equal(events[late], whole[whole["t"] >= 540_000])
    assert {p.kind: p.count for p in lossy.problems}["overflow"] == 1


def test_darkness_does_not_stop_images(recording):
    with Session(source(recording, dark=0.4), **OPTIONS, method="cf") as session:
        assert [image.t_us for image in session][-1] > 900_000


def test_a_reset_clock_begins_a_segment_and_images_go_on(recording):
    class Resetting(Faulty):
        def read(self, timeout_s):
            transfers = self.device.read(timeout_s)
            if transfers is None:
                return None
            one, = transfers
            if self.lose[0] == 9e9 and one.host_s >= 0.5:
                self.lose = (0, 0)
                data = np.array([1], "<u2").tobytes()
                return [Transfer(one.data + data, one.host_s)]
            return transfers

    device = Resetting(SimulatedDavis346(recording))
    with Session(unpaced(device), **OPTIONS, method="cf") as session:
        times = [image.t_us for image in session]
        assert np.all(np.diff(times) > 0)
        assert "segment" in [problem.kind for problem in session.problems]


def test_a_camera_that_hangs_is_told(recording, monkeypatch):
    monkeypatch.setattr("pdavis_cv.live.usb.SILENCE_S", 0.0)
    silent = source(recording, lose=(0.2, 9e9))
    with silent, pytest.raises(DeviceError, match="has sent nothing for 0 s"):
        list(silent.packets())


# ---- a camera by its address -------------------------------------------------------


def test_an_address_that_is_not_understood_is_told(monkeypatch):
    with pytest.raises(DeviceError, match="there is no 'nonsense'; a camera takes"):
        open_source("usb:?nonsense=1")
    with pytest.raises(DeviceError, match="exposure_us must be a number"):
        open_source("usb:?exposure_us=x")
    monkeypatch.setitem(sys.modules, "neuromorphic_drivers", None)
    with pytest.raises(ImportError, match="pip install neuromorphic-drivers"):
        open_source("usb:")
    capture = VideoCapture("usb:")
    assert not capture.isOpened()
    assert "pip install neuromorphic-drivers" in capture.last_error


# ---- the driver ------------------------------------------------------------------


@dataclass
class Biases:
    prbp: int = 575


for _name in camera.BIASES:
    if _name != "prbp":
        setattr(Biases, _name, 1000)


@dataclass
class Configuration:
    biases: Biases = field(default_factory=Biases)
    activity_filter: object = field(
        default_factory=lambda: types.SimpleNamespace(mask_isolated_enable=True))
    exposure_us: int = 4000
    frame_interval_us: int = 40_000


class Driver(types.ModuleType):
    """Stands in for neuromorphic_drivers, with what of it is used."""

    def __init__(self, transfers):
        super().__init__("neuromorphic_drivers")
        self.inivation_davis346 = types.SimpleNamespace(Configuration=Configuration)
        self.transfers, self.set, self.closed = iter(transfers), [], False

    def list_devices(self):
        name = types.SimpleNamespace(name="INIVATION_DAVIS346", value="DAVIS 346")
        other = types.SimpleNamespace(name="PROPHESEE_EVK4", value="EVK4")
        usb = types.SimpleNamespace(value="USB 3.0")
        return [types.SimpleNamespace(name=n, serial=s, connection=usb, error=None)
                for n, s in ((name, "00000346"), (other, "7"), (name, "00000347"))]

    def open(self, *, configuration, iterator_timeout, raw, serial):
        assert raw
        assert iterator_timeout > 0
        if serial not in (None, "00000346", "00000347"):
            raise RuntimeError("device not found")
        self.serial_number = serial or "00000346"
        self.update_configuration(configuration)
        return self

    def update_configuration(self, configuration):
        self.set.append((configuration.exposure_us, configuration.biases.prbp,
                         configuration.activity_filter.mask_isolated_enable))

    def orientation(self):
        return types.SimpleNamespace(
            dvs_invert_xy=False, aps_flip_x=False, aps_flip_y=True,
            aps_invert_xy=False, imu_flip_x=True, imu_flip_y=False, imu_flip_z=False)

    def imu_type(self):
        return "InvenSense6050Or6150"

    def serial(self):
        return self.serial_number

    def __next__(self):
        found = next(self.transfers)
        if isinstance(found, Exception):
            raise found
        return found

    def close(self):
        self.closed = True


def status(gaps=(), delay_s=0.25):
    ring = types.SimpleNamespace(
        system_time=1e9, overflow_indices=list(gaps), dropped_packets=len(gaps))
    return types.SimpleNamespace(system_time=1e9 + delay_s, ring=ring)


NOTHING = types.SimpleNamespace(system_time=1e9, ring=None), None


@pytest.fixture
def driver(monkeypatch):
    def made(*transfers):
        one = Driver(transfers)
        monkeypatch.setitem(sys.modules, "neuromorphic_drivers", one)
        return one
    return made


def words(*values):
    return np.array(values, "<u2").tobytes()


def test_a_camera_is_set_and_says_how(driver):
    fake = driver()
    with open_source("usb:00000347?exposure_us=8000&prbp=600") as live:
        assert live.info.serial == "00000347"
        assert live.info.exposure_us == 8000
        assert live.info.header["background_activity_filter"] is False
        assert live.device.settings["prbp"] == 600
        live.device.set(exposure_us=9000)
        assert live.device.settings["exposure_us"] == 9000
        with pytest.raises(ValueError, match=r"prbp must lie in 0\.\.2040, got 2041"):
            live.device.set(exposure_us=1, prbp=2041)
        with pytest.raises(ValueError, match="there is no setting 'gain'"):
            live.device.set(gain=1)
        assert live.device.settings["exposure_us"] == 9000
        assert live.device.orientation == Orientation(
            frames_flipped_y=True, imu_flipped=(True, False, False))
    assert fake.set == [(8000, 600, False), (9000, 600, False)]
    assert fake.closed


def test_what_the_driver_hands_out_is_decoded_and_losses_are_counted(driver):
    event = words(0x8005, 0x1003, 0x3004)
    later = words(0x8009, 0x1003, 0x3005)
    driver(NOTHING, (status(), event), (status([6]), later + later),
           RuntimeError("no device"))
    with open_source("usb:") as live:
        packets = []
        with pytest.raises(DeviceError, match=r"DAVIS346 00000346: the device is gone: "
                                              r"plug it in and open it again \(no dev"):
            packets.extend(live.packets())
        events = np.concatenate([packet.events for packet in packets])
        assert events.tolist() == [(5, 4, 3, 1), (9, 5, 3, 1), (9, 5, 3, 1)]
        assert [p.kind for p in live.problems] == ["overflow"]


def test_a_camera_that_is_not_there_is_told(driver):
    driver()
    with pytest.raises(DeviceError, match="no camera 12 could be opened: device not"):
        open_source("usb:12")


def test_a_number_opens_a_camera_as_cv2_does(driver):
    driver((status(), words(0x8005)), *[NOTHING] * 99)
    with VideoCapture(1, CAP_PDAVIS, **OPTIONS) as capture:
        assert capture.isOpened(), capture.last_error
        assert capture.getBackendName() == "PDAVIS"
    capture = VideoCapture(2, CAP_PDAVIS)
    assert not capture.isOpened()
    assert "2 cameras are plugged in" in capture.last_error


# ---- traces and the command ----------------------------------------------------------


def test_a_trace_is_a_recording(recording, tmp_path):
    path = tmp_path / "trace.usb"
    write_trace(path, recording)
    with open_recording(path, layout=Layout.PDAVIS) as read:
        np.testing.assert_array_equal(read.events(), recording.events())
        frames = [frame for packet in read.packets() for frame in packet.frames]
        assert len(frames) == 20
        assert frames[0].reset is not None
        middle = [packet.start_us for packet in read.packets(500_000, 600_000)]
        assert min(middle) >= 500_000
        assert read.info.sensor_size == (8, 8)
    data = path.read_bytes()
    path.write_bytes(data[:-7])
    with open_recording(path, layout=Layout.PDAVIS) as cut, pytest.warns(
            pdavis_cv.DamagedFileWarning, match="a transfer is cut short"):
        assert len(cut.events()) > 1000
    path.write_bytes(data[:20])
    with pytest.raises(pdavis_cv.RecordingError, match="about the camera is damaged"):
        open_recording(path)


def test_devices_are_listed(driver, capsys):
    driver()
    assert devices.main([]) == 0
    assert "usb:00000346" in capsys.readouterr().out
    assert devices.main(["--json"]) == 0
    assert [one["serial"] for one in json.loads(capsys.readouterr().out)] == [
        "00000346", "00000347"]


def test_a_trace_is_recorded_by_the_command(driver, capsys, tmp_path):
    path = tmp_path / "t.usb"
    event = words(0x8005, 0x1003, 0x3004)
    driver((status(), event), NOTHING, (status(), words(0x8009)), RuntimeError("gone"))
    assert devices.main(["--record-raw", str(path), "--seconds", "60"]) == 2
    assert "the device is gone" in capsys.readouterr().err
    with open_recording(path) as read:
        assert read.events().tolist() == [(5, 4, 3, 1)]
        assert read.info.serial == "00000346"


def test_without_the_driver_the_command_says_what_is_missing(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "neuromorphic_drivers", None)
    assert devices.main([]) == 2
    assert "pip install neuromorphic-drivers" in capsys.readouterr().err
