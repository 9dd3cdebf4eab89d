"""pdavis export --what aop-events: what AopEvents gives, in files."""
import csv
import json
import signal

import aedat
import cv2
import numpy as np
import pytest

import pdavis_cv
from pdavis_cv import RecordingError
from pdavis_cv.data import example_recording
from pdavis_cv.export import AopEventsFile, read_aop_events
from pdavis_cv.render import aop_bgr
from pdavis_cv.tools.main import main

SAMPLE = str(example_recording())
MORE = ["--what", "aop-events", "--layout", "pdavis", "--start", "0.1", "--stop", "0.2",
        "--set", "correct_phase=true"]


@pytest.fixture(scope="module")
def expected():
    with pdavis_cv.open_recording(SAMPLE, layout="pdavis") as recording:
        start = recording.info.start_us or 0
        stream = pdavis_cv.AopEvents(
            recording.info.sensor_size, theta_on=0.2, theta_off=0.2,
            layout="pdavis", correct_phase=True)
        return stream.add(recording.events(start + 100_000, start + 200_000))


def test_the_array_holds_the_stream(tmp_path, expected):
    out = tmp_path / "aop.npy"
    assert main(["export", SAMPLE, "-o", str(out), *MORE]) == 0
    np.testing.assert_array_equal(np.load(out), expected)
    facts = json.loads((tmp_path / "aop.npy.json").read_text())
    assert facts["units"]["aop"] == "rad"
    assert facts["correct_phase"] is True


def test_a_disk_without_room_for_the_last_byte_is_an_error(tmp_path, capsys):
    resource = pytest.importorskip("resource")
    out = tmp_path / "aop.npy"
    assert main(["export", SAMPLE, "-o", str(out), *MORE]) == 0
    size = out.stat().st_size
    out.unlink()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    previous = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size - 1, hard))
    try:
        code = main(["export", SAMPLE, "-o", str(out), *MORE])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, previous)
    assert code == 1
    assert str(out) in capsys.readouterr().err
    assert not out.exists()


def test_the_table_holds_it_in_degrees(tmp_path, expected):
    out = tmp_path / "aop.csv"
    assert main(["export", SAMPLE, "-o", str(out), *MORE]) == 0
    with out.open() as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["t_us", "x", "y", "aop_deg"]
    found = np.array(rows[1:], float)
    for k, name in enumerate("txy"):
        np.testing.assert_array_equal(found[:, k], expected[name])
    np.testing.assert_allclose(found[:, 3], np.rad2deg(expected["aop"]), atol=6e-4)


@pytest.fixture(scope="module")
def triple(tmp_path_factory):
    out = tmp_path_factory.mktemp("triple") / "aop.aedat4"
    assert main(["export", SAMPLE, "-o", str(out), *MORE, "--fps", "20"]) == 0
    return out


def steps_of(angles):
    return np.rint(angles["aop"].astype(float) / np.pi * 18_000).astype(int) % 18_000


def test_a_file_of_three_streams_reads_back(triple, expected):
    found = read_aop_events(triple)
    for name in "txy":
        np.testing.assert_array_equal(found[name], expected[name])
    off = np.rad2deg(found["aop"].astype(float) - expected["aop"])
    assert np.abs((off + 90) % 180 - 90).max() < 0.0051


def test_it_opens_as_a_recording_of_these_events_and_of_pictures_of_angles(
        triple, expected):
    with pdavis_cv.open_recording(triple) as recording:
        assert str(recording.info.layout) == str(pdavis_cv.Layout.PDAVIS)
        events = recording.events()
        frames = [frame for packet in recording.packets() for frame in packet.frames]
        assert not recording.problems
    for name in "txy":
        np.testing.assert_array_equal(events[name], expected[name])
    assert len(frames) == 2
    start = int(expected["t"][0])
    for k, frame in enumerate(frames):
        mine = expected[(expected["t"] >= start + 50_000 * k)
                        & (expected["t"] < start + 50_000 * (k + 1))]
        last = np.full(frame.shape, 18_000)
        last[mine["y"], mine["x"]] = steps_of(mine)
        np.testing.assert_array_equal(frame.dn, last)
        np.testing.assert_array_equal(frame.valid, last < 18_000)
        assert frame.exposure_start_us == start + 50_000 * k


def test_others_read_all_three(triple, expected):
    got = {}
    for packet in aedat.Decoder(triple):
        kind = "events" if "events" in packet else "frame"
        got.setdefault(packet["stream_id"], []).append(packet[kind])
    events, frames, angles = (got[number] for number in sorted(got))
    events, angles = np.concatenate(events), np.concatenate(angles)
    np.testing.assert_array_equal(events["t"], expected["t"])
    np.testing.assert_array_equal(angles["t"], expected["t"])
    np.testing.assert_array_equal(angles["x"], steps_of(expected))
    assert len(frames) == 2
    assert frames[0]["pixels"].max() == 18_000

    dv = pytest.importorskip("dv_processing")
    reader = dv.io.MonoCameraRecording(str(triple))
    assert {"events", "frames", "aop"} <= set(reader.getStreamNames())
    for name, column, wanted in (("events", "x", expected["x"]),
                                 ("aop", "x", steps_of(expected))):
        parts = []
        while (batch := reader.getNextEventBatch(name)) is not None:
            parts.append(batch.numpy())
        np.testing.assert_array_equal(np.concatenate(parts)[column], wanted)


def test_intervals_without_events_have_no_frame_and_time_goes_on(tmp_path):
    path, size = tmp_path / "x.aedat4", (4, 6)
    events = np.zeros(4, pdavis_cv.EVENT_DTYPE)
    events["t"], events["x"], events["y"] = [5, 9_999, 35_000, 90_004], [0, 1, 2, 5], 3
    angles = np.zeros(4, pdavis_cv.AOP_EVENT_DTYPE)
    for name in "txy":
        angles[name] = events[name]
    angles["aop"] = [0.1, 3.1415926, 1.0, 2.0]      # the second rounds to 0
    with AopEventsFile(path, sensor_size=size) as file:
        file.add_angles(events[:1], angles[:1])
        file.add_angles(events[1:], angles[1:])
        with pytest.raises(ValueError, match="angles must be those of the events"):
            file.add_angles(events[:1], angles[1:2])
    assert file.frames == 3
    with pdavis_cv.open_recording(path) as recording:
        starts = [frame.exposure_start_us for packet in recording.packets()
                  for frame in packet.frames]
    assert starts == [5, 30_005, 80_005]
    np.testing.assert_allclose(read_aop_events(path)["aop"], [0.1, 0, 1, 2], atol=1e-4)


def test_a_recording_without_angles_is_refused():
    with pytest.raises(RecordingError, match="no stream of angles"):
        read_aop_events(SAMPLE)
    with pytest.raises(ValueError, match="fps must lie"):
        AopEventsFile("never.aedat4", sensor_size=(2, 2), fps=0)


def test_a_picture_shows_each_pixels_last_angle(tmp_path, expected):
    out = tmp_path / "aop.avi"
    assert main(["export", SAMPLE, "-o", str(out), *MORE, "--fps", "20"]) == 0
    video = cv2.VideoCapture(str(out))
    first = video.read()[1]
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 2
    video.release()
    with pdavis_cv.open_recording(SAMPLE, layout="pdavis") as recording:
        shape, start = recording.info.sensor_size, recording.info.start_us or 0
    last = np.full(shape, np.nan, np.float32)
    mine = expected[expected["t"] < start + 150_000]
    last[mine["y"], mine["x"]] = mine["aop"]
    scale = first.shape[0] // shape[0]
    small = cv2.resize(first, shape[::-1], interpolation=cv2.INTER_AREA).astype(float)
    assert scale * shape[1] >= 240
    dark = np.isnan(last)
    # A video codec blurs colours; what is dark and what is not stays apart.
    assert small[~dark].max(-1).mean() > 3 * small[dark].max(-1).mean()
    hue = aop_bgr(last)[~dark].astype(float)
    # .79: colours of sparse pixels blur
    assert np.corrcoef(hue.ravel(), small[~dark].ravel())[0, 1] > 0.7


@pytest.mark.parametrize(("more", "said"), [
    (["-o", "aop.png"], "must end in .csv"),
    (["-o", "aop.npy", "--set", "foo=1"], "takes cutoff_hz, radius"),
])
def test_what_it_cannot_do_is_one_line(more, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["export", SAMPLE, "--what", "aop-events", "--layout", "pdavis",
                 *more]) == 2
    assert said in capsys.readouterr().err
