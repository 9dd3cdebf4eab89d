import contextlib
import json

import cv2
import numpy as np
import pytest
from cv2_manners import needs_animations

from pdavis_cv import ApsFrame, export, recording_from_arrays
from pdavis_cv.events import EVENT_DTYPE


def read_video(path):
    reader = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    assert reader.isOpened()
    frames = []
    while True:
        done, frame = reader.read()
        if not done:
            break
        frames.append(frame)
    reader.release()
    return frames


def pictures(n, shape):
    """Smooth pictures that differ, as codecs like them."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    return [np.stack([(y + 10 * i) % 256, x % 256, np.full(shape, 20 * i)],
                     axis=-1).astype(np.uint8) for i in range(n)]


@pytest.mark.parametrize("suffix", [".webm", ".mp4", ".mkv", ".avi", ".m4v"])
@pytest.mark.parametrize("shape", [(64, 96), (65, 97)])
def test_video_holds_every_picture_whole(tmp_path, suffix, shape):
    path = tmp_path / f"clip{suffix}"
    wanted = pictures(7, shape)
    with export.VideoFile(path, 25) as video:
        same = np.empty_like(wanted[0])
        for picture in wanted:
            same[:] = picture   # the caller may use its memory again at once
            video.add(same)
    got = read_video(path)
    assert len(got) == 7
    for a, b in zip(got, wanted, strict=True):
        assert a.shape[:2] == (shape[0] + shape[0] % 2, shape[1] + shape[1] % 2)
        assert np.abs(a[:shape[0], :shape[1]].astype(int) - b).mean() < 6
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("shape", [(64, 96), (65, 97)])
def test_mp4_is_what_slide_programs_play(tmp_path, shape):
    av = pytest.importorskip("av")
    path, wanted = tmp_path / "clip.mp4", pictures(7, shape)
    with export.VideoFile(path, 29.97, {"method": "none"}) as video:
        for picture in wanted:
            video.add(picture)
    assert video.codec in ("H.264 (libx264)", "H.264 (libopenh264)", "vp09")
    with av.open(str(path)) as file:
        stream, = file.streams.video
        assert stream.codec_context.name == (
            "vp9" if video.codec == "vp09" else "h264")
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert (stream.width, stream.height) == (96 + shape[1] % 2 * 2,
                                                 64 + shape[0] % 2 * 2)
        assert float(stream.average_rate) == pytest.approx(29.97, rel=1e-4)
        got = [frame.to_ndarray(format="bgr24") for frame in file.decode(stream)]
    assert len(got) == 7
    for a, b in zip(got, wanted, strict=True):
        assert np.abs(a[:shape[0], :shape[1]].astype(int) - b).mean() < 6
    assert export.read_embedded(path) == {"method": "none"}


@pytest.mark.parametrize("suffix", [".mp4", ".m4v"])
def test_without_an_encoder_of_h264_opencv_writes(tmp_path, monkeypatch, suffix):
    monkeypatch.setattr("pdavis_cv.export.video.h264_encoder", lambda: None)
    with export.VideoFile(tmp_path / f"clip{suffix}", 25) as video:
        for picture in pictures(3, (64, 96)):
            video.add(picture)
    assert video.codec == {".mp4": "vp09", ".m4v": "mp4v"}[suffix]
    assert len(read_video(tmp_path / f"clip{suffix}")) == 3


def test_a_picture_that_was_added_may_be_drawn_over(tmp_path):
    path, wanted = tmp_path / "clip.mp4", pictures(11, (64, 96))
    with export.VideoFile(path, 25) as video:
        memory = np.empty_like(wanted[0])
        for picture in wanted:
            memory[:] = picture
            video.add(memory)
            memory[:] = 255
    got = read_video(path)
    assert len(got) == 11
    for a, b in zip(got, wanted, strict=True):
        assert np.abs(a.astype(int) - b).mean() < 6


def test_png_returns_the_picture(tmp_path):
    picture = pictures(1, (33, 35))[0]
    export.write_png(tmp_path / "a.png", picture)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.png")), picture)


def test_json_takes_numpy_numbers(tmp_path):
    export.write_json(tmp_path / "a.json", {
        "t": np.arange(3), "step": np.float64(0.5), "path": tmp_path})
    assert json.loads((tmp_path / "a.json").read_text()) == {
        "t": [0, 1, 2], "step": 0.5, "path": str(tmp_path)}


def test_what_is_interrupted_leaves_nothing_and_keeps_what_was_there(tmp_path):
    old = tmp_path / "x.mp4"
    old.write_text("before")
    with pytest.raises(KeyboardInterrupt):  # noqa: PT012
        with export.VideoFile(old, 25) as file:
            file.add(np.zeros((32, 32, 3), np.uint8))
            raise KeyboardInterrupt
    assert [p.name for p in tmp_path.iterdir()] == ["x.mp4"]
    assert old.read_text() == "before"


@needs_animations
@pytest.mark.parametrize(("suffix", "far"), [(".gif", 9), (".webp", 3)])
def test_an_animation_repeats_every_picture_in_its_time(tmp_path, suffix, far):
    path, wanted = tmp_path / f"clip{suffix}", pictures(7, (65, 97))
    facts = {"method": "none", "label": "größe !" * 60}
    with export.moving_file(path, 30, facts) as file:
        assert isinstance(file, export.AnimationFile)
        same = np.empty_like(wanted[0])
        for picture in wanted:
            same[:] = picture
            file.add(same)
    read, animation = cv2.imreadanimation(str(path))
    assert read
    assert animation.loop_count == 0
    assert len(animation.frames) == 7
    # 30 per second in units of 10 and of 1 ms: it does not run away
    assert abs(sum(animation.durations) - 7 * 1000 / 30) <= 5
    for got, picture in zip(animation.frames, wanted, strict=True):
        # near by near: GIF has 256 colours and mixes others of them
        a, b = (cv2.blur(one[..., :3], (15, 15)).astype(int) for one in (got, picture))
        assert np.abs(a - b).mean() < far
    assert export.read_embedded(path) == facts
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    image = pytest.importorskip("PIL.Image")
    with image.open(path) as other:
        assert (other.n_frames, other.size, other.info["loop"]) == (7, (97, 65), 0)


@needs_animations
def test_impossible_animations_are_refused(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"\.01\.\.50 for \.gif, got 60; play it slow"):
        export.AnimationFile(tmp_path / "x.gif", 60)
    with pytest.raises(ValueError, match=r"must end in \.gif, \.webp, got '\.png'"):
        export.AnimationFile(tmp_path / "x.png", 25)
    with pytest.raises(ValueError, match="no picture"), \
            export.AnimationFile(tmp_path / "x.gif", 25):
        pass
    monkeypatch.setattr("pdavis_cv.export.animation._MOST_BYTES", 3000)
    with pytest.raises(ValueError, match="up to 2 GiB or 1 pictures"):  # noqa: PT012
        with export.AnimationFile(tmp_path / "x.gif", 25) as file:
            for _ in range(2):
                file.add(np.zeros((20, 30, 3), np.uint8))
    assert not list(tmp_path.iterdir())


def test_a_video_without_pictures_is_no_file(tmp_path):
    with pytest.raises(ValueError, match="no picture"), \
            export.VideoFile(tmp_path / "x.mp4", 25):
        pass
    assert not list(tmp_path.iterdir())


def test_impossible_video_parameters_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"must end in \.webm.*got '\.gif'"):
        export.VideoFile(tmp_path / "x.gif", 25)
    with pytest.raises(ValueError, match=r"must lie in 0\.01\.\.60000 .*, got 0"):
        export.VideoFile(tmp_path / "x.mp4", 0)
    with pytest.raises(FileNotFoundError):
        export.VideoFile(tmp_path / "nowhere" / "x.mp4", 25)
    assert not list(tmp_path.iterdir())


def test_pictures_of_a_video_keep_one_shape(tmp_path):
    with pytest.raises(ValueError, match="first one's shape"):  # noqa: PT012
        with export.VideoFile(tmp_path / "x.mp4", 25) as video:
            video.add(np.zeros((32, 32, 3), np.uint8))
            video.add(np.zeros((34, 32, 3), np.uint8))


def test_videos_written_at_once_give_opencv_its_log_level_back(tmp_path):
    logging = cv2 if hasattr(cv2, "setLogLevel") else cv2.utils.logging
    before = logging.getLogLevel()
    logging.setLogLevel(4)      # information; 0 is nothing
    try:
        with contextlib.ExitStack() as first, contextlib.ExitStack() as second:
            one = first.enter_context(export.VideoFile(tmp_path / "one.mp4", 25))
            two = second.enter_context(export.VideoFile(tmp_path / "two.mp4", 25))
            for video in (one, two):
                video.add(np.zeros((32, 48, 3), np.uint8))
            first.close()
            assert logging.getLogLevel() == 0
            second.close()
            assert logging.getLogLevel() == 4
    finally:
        logging.setLogLevel(before)


@pytest.mark.parametrize("limit", [0, 3_000, 20_000, 60_000])
@pytest.mark.parametrize("suffix", [".webm", ".mp4", ".mkv", ".avi"])
def test_a_full_disk_is_noticed(tmp_path, suffix, limit):
    resource = pytest.importorskip("resource")
    import signal
    rng = np.random.default_rng(0)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    previous = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        with pytest.raises(OSError, match=r"could not all be|cannot write"):  # noqa: PT012
            with export.VideoFile(tmp_path / f"x{suffix}", 25) as video:
                for _ in range(100):
                    video.add(rng.integers(0, 255, (64, 64, 3), np.uint8))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, previous)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("frame", "unit"), [
    ([], "1"), ([ApsFrame(np.ones((4, 4), np.float32), 0, 20_000)], "DN/ms"),
    ([ApsFrame(np.ones((4, 4), np.float32), 0, 0)], "DN")])
def test_the_unit_of_light_is_what_the_recording_can_tell(frame, unit):
    recording = recording_from_arrays(
        np.zeros(1, EVENT_DTYPE), frame, sensor_size=(4, 4))
    assert export.light_unit(recording) == unit


def test_an_opencv_without_animations_is_refused(tmp_path, monkeypatch):
    monkeypatch.delattr(cv2, "imencodeanimation", raising=False)
    with pytest.raises(ImportError, match=r"needs OpenCV 4\.12 or later, this is \d"):
        export.AnimationFile(tmp_path / "x.gif", 25)
