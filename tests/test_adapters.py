"""Real programs read whole recordings through the adapters."""
import pickle
import sys
import threading
import types

import cv2
import numpy as np
import pytest

import pdavis_cv as p
from pdavis_cv import Layout, VideoCapture, patched_cv2
from pdavis_cv.data import example_recording

OPTIONS = {"fps": 500, "layout": Layout.PDAVIS, "method": "frames"}
N = 87  # images in 0.17 s
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.fixture(scope="module")
def path():
    return str(example_recording())


@pytest.fixture(scope="module")
def expected(path):
    with VideoCapture(path, **OPTIONS) as cap:
        images = list(cap)
    assert len(images) == N
    return images


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("clips") / "clip.avi"
    writer = cv2.VideoWriter(
        str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), 25, (64, 48),
        [cv2.VIDEOWRITER_PROP_IS_COLOR, 0])
    for k in range(5):
        writer.write(np.full((48, 64), 20 + k, np.uint8))
    writer.release()
    return str(path)


def check(images, expected):
    assert len(images) == len(expected)
    np.testing.assert_array_equal(images[0], expected[0])
    np.testing.assert_array_equal(images[-1], expected[-1])


# ---- patched_cv2 ----------------------------------------------------------------


def test_imutils_reads_the_whole_recording(path, expected):
    video = pytest.importorskip("imutils.video")
    with patched_cv2(**OPTIONS):
        stream = video.FileVideoStream(path).start()
    images = []
    while stream.running():
        image = stream.read()
        if image is None:
            break
        images.append(image)
    stream.stop()
    check(images, expected)


def test_supervision_reads_and_writes_the_whole_recording(path, expected, tmp_path):
    sv = pytest.importorskip("supervision")
    with patched_cv2(**OPTIONS):
        info = sv.VideoInfo.from_video_path(path)
        assert (info.width, info.height, info.fps, info.total_frames) == (
            346, 260, 500, len(expected))
        images = []
        with sv.VideoSink(str(tmp_path / "out.mp4"), info) as sink:
            for image in sv.get_video_frames_generator(path):
                images.append(image)
                sink.write_frame(image)
        part = list(sv.get_video_frames_generator(path, stride=7, start=30, end=80))
    check(images, expected)
    np.testing.assert_array_equal(part, expected[30:80:7])
    # The real class again, and it reads what was written.
    written = list(sv.get_video_frames_generator(str(tmp_path / "out.mp4")))
    assert len(written) == len(expected)
    assert np.abs(written[50].astype(float) - expected[50]).mean() < 8


def test_vidgear_reads_the_whole_recording(path, expected):
    gears = pytest.importorskip("vidgear.gears")
    with patched_cv2(**OPTIONS):
        stream = gears.CamGear(path, THREADED_QUEUE_MODE=True).start()
    images = []
    while (image := stream.read()) is not None:
        images.append(image)
    stream.stop()
    check(images, expected)


def test_the_calls_of_ultralytics_loader_of_streams_read_every_image(path, expected):
    """The calls of LoadStreams, in their order: the first image, then a thread."""
    with patched_cv2(**OPTIONS):
        cap = cv2.VideoCapture(path)
    assert cap.isOpened()
    assert (int(cap.get(cv2.CAP_PROP_FRAME_WIDTH)),
            int(cap.get(cv2.CAP_PROP_FRAME_HEIGHT))) == (346, 260)
    assert cap.get(cv2.CAP_PROP_FPS) == 500
    frames = max(int(cap.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
    assert frames == len(expected)
    ok, image = cap.read()
    assert ok
    images = [image]

    def update():
        n = 0
        while cap.isOpened() and n < frames - 1:
            n += 1
            cap.grab()
            ok, image = cap.retrieve()
            assert ok
            images.append(image)

    thread = threading.Thread(target=update, daemon=True)
    thread.start()
    thread.join()
    cap.release()
    check(images, expected)


def test_ultralytics_reads_a_list_of_streams_whole(path, expected, tmp_path):
    build = pytest.importorskip("ultralytics.data.build")
    (tmp_path / "run.streams").write_text(path)
    with patched_cv2(**OPTIONS):
        loader = build.load_inference_source(str(tmp_path / "run.streams"), buffer=True)
        images = [image for _, batch, _ in loader for image in batch]
    check(images, expected)


def test_other_sources_go_to_the_real_class(clip):
    with patched_cv2(**OPTIONS):
        cap = cv2.VideoCapture(clip)
        assert cap.isOpened()
        assert cap.getBackendName() == "FFMPEG"
        assert [cap.read()[0] for _ in range(6)] == 5 * [True] + [False]
        cap.release()
        cap = cv2.VideoCapture()
        assert cap.open(clip)
        cap.release()
        assert not cv2.VideoCapture("missing.avi").isOpened()


def test_mosaics_are_read_when_asked_for(clip):
    with patched_cv2(layout=Layout.SONY, mosaics=True):
        cap = cv2.VideoCapture(clip)
        assert cap.getBackendName() == "PDAVIS"
        assert len(list(cap)) == 5
        cap.release()
    with pytest.raises(ValueError, match="needs layout="), patched_cv2(mosaics=True):
        pass


def test_the_real_class_comes_back_everywhere(path):
    real = cv2.VideoCapture
    copy = types.ModuleType("copy_of_names")
    copy.VideoCapture = real
    own = types.ModuleType("own_class")
    own.VideoCapture = dict
    sys.modules["copy_of_names"] = copy
    late = types.ModuleType("late_copy")
    try:
        with patched_cv2(own, **OPTIONS) as patched:
            assert cv2.VideoCapture is patched is copy.VideoCapture is own.VideoCapture
            assert patched is not real
            late.VideoCapture = cv2.VideoCapture   # imported while it was in force
            sys.modules["late_copy"] = late
            with patched_cv2(fps=1) as inner:
                assert cv2.VideoCapture is copy.VideoCapture is inner
            assert cv2.VideoCapture is copy.VideoCapture is late.VideoCapture is patched
        assert cv2.VideoCapture is copy.VideoCapture is late.VideoCapture is real
        assert own.VideoCapture is dict
    finally:
        sys.modules.pop("copy_of_names")
        sys.modules.pop("late_copy", None)


def test_an_error_inside_brings_the_real_class_back():
    real = cv2.VideoCapture
    with pytest.raises(ZeroDivisionError), patched_cv2(**OPTIONS):
        raise ZeroDivisionError
    assert cv2.VideoCapture is real


def test_isinstance_works_while_patched(path):
    with patched_cv2(**OPTIONS):
        cap = cv2.VideoCapture(path)
        assert isinstance(cap, cv2.VideoCapture)
        assert isinstance(cap, VideoCapture)
        cap.release()


def test_a_patched_capture_pickles(path, expected):
    with patched_cv2(**OPTIONS):
        cap = cv2.VideoCapture(path)
        cap.set(1, 80)
        copy = pickle.loads(pickle.dumps(cap))
        cap.release()
    check(list(copy), expected[80:])
    copy.release()


def test_an_unknown_parameter_is_refused_before_anything_is_patched():
    real = cv2.VideoCapture
    with pytest.raises(TypeError, match="no parameter 'speed'"), patched_cv2(speed=1):
        pass
    assert cv2.VideoCapture is real


# ---- pims -----------------------------------------------------------------------


def test_pims_slices_the_recording(path, expected):
    pims = pytest.importorskip("pims")
    from pdavis_cv.adapters.pims_reader import PdavisSequence
    with pims.open(path, output=p.CAP_PDAVIS_BGR, **OPTIONS) as frames:
        assert isinstance(frames, PdavisSequence)
        assert frames.shape == (len(expected), 260, 346, 3)
        assert frames.dtype == np.uint8
        check(list(frames), expected)
        np.testing.assert_array_equal(list(frames[80:10:-13]), expected[80:10:-13])
        np.testing.assert_array_equal(frames[-1], expected[-1])
        assert frames[7].frame_no == 7
        assert frames[8].metadata["t_us"] - frames[0].metadata["t_us"] == 16_000
        halved = pims.pipeline(lambda image: image // 2)(frames)[5:7]
        np.testing.assert_array_equal(halved[1], expected[6] // 2)
        copy = pickle.loads(pickle.dumps(frames))
        np.testing.assert_array_equal(copy[50], expected[50])
        copy.close()


def test_pims_shares_a_recording_among_threads(path, expected):
    pytest.importorskip("pims")
    from pdavis_cv.adapters.pims_reader import PdavisSequence
    wrong = []
    with PdavisSequence(path, output=p.CAP_PDAVIS_BGR, **OPTIONS) as frames:
        def read(k):
            for i in range(k, N, 8):
                if not np.array_equal(frames[i], expected[i]):
                    wrong.append(i)
        threads = [threading.Thread(target=read, args=(k,)) for k in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert not wrong


def test_pims_says_why_a_file_is_not_opened(tmp_path):
    pytest.importorskip("pims")
    from pdavis_cv.adapters.pims_reader import PdavisSequence
    with pytest.raises(OSError, match=r"none\.aedat4: cannot be opened"):
        PdavisSequence(tmp_path / "none.aedat4")


# ---- imageio ----------------------------------------------------------------------


@pytest.fixture
def iio():
    module = pytest.importorskip("imageio.v3")
    from pdavis_cv.adapters.imageio_plugin import register
    register()
    register()
    return module


def test_imageio_iterates_over_the_recording(path, expected, iio):
    for keywords in ({}, {"plugin": "pdavis"}):
        images = list(iio.imiter(path, **keywords, **OPTIONS))
        check([image[..., ::-1] for image in images], expected)


def test_imageio_reads_one_image_or_all(path, expected, iio):
    np.testing.assert_array_equal(
        iio.imread(path, index=33, **OPTIONS)[..., ::-1], expected[33])
    with iio.imopen(path, "r", **OPTIONS) as file:
        np.testing.assert_array_equal(file.read(index=-1)[..., ::-1], expected[-1])
        assert file.read(index=...).shape == (N, 260, 346, 3)
        everything = file.properties(index=...)
        assert (everything.n_images, everything.shape) == (N, (N, 260, 346, 3))
        assert file.properties(index=3).dtype == np.uint8
        assert file.metadata(index=8)["t_us"] - file.metadata(index=0)["t_us"] == (
            16_000)
        assert file.metadata(index=...) == {"fps": 500.0}
        for index in (N, -N - 1):
            with pytest.raises(IndexError, match="holds no image"):
                file.read(index=index)
    dolp = iio.imread(path, index=3, output=p.CAP_PDAVIS_DOLP, **OPTIONS)
    assert (dolp.dtype, dolp.shape) == (np.float32, (260, 346))


def test_imageio_metadata_after_read_reads_nothing(path, iio, monkeypatch):
    with iio.imopen(path, "r", **OPTIONS) as file:
        expected = [file.metadata(index=k)["t_us"] for k in range(4)]
        file.read(index=3)
        reads, real = [], VideoCapture.read
        monkeypatch.setattr(
            VideoCapture, "read", lambda self: (reads.append(1), real(self))[1])
        assert file.metadata(index=3)["t_us"] == expected[3]
        assert not reads
        assert file.metadata(index=1)["t_us"] == expected[1]
        assert len(reads) == 1
        with pytest.raises(IndexError):
            file.read(index=N)
        assert file.metadata(index=N - 1)["t_us"] - expected[0] == 2_000 * (N - 1)
        for k, _ in zip(range(4), file.iter(), strict=False):
            assert file.metadata(index=k)["t_us"] == expected[k]


@pytest.mark.usefixtures("iio")
def test_imageio_v2_keeps_the_parameters(path, expected):
    v2 = pytest.importorskip("imageio.v2")
    with v2.get_reader(path, format="pdavis", **OPTIONS) as reader:
        for k in (0, 1, 7):
            image = reader.get_data(k)
            np.testing.assert_array_equal(np.asarray(image)[..., ::-1], expected[k])
            assert image.meta["fps"] == 500
        assert reader.get_length() == N


def test_imageio_gets_a_reason_for_what_is_no_recording(tmp_path, iio, clip):
    bad = tmp_path / "bad.aedat4"
    bad.write_text("text")
    for source in (str(bad), clip):
        with pytest.raises(OSError, match="can not handle"):
            iio.imread(source, plugin="pdavis")
    with pytest.raises(OSError, match="can not handle"):
        iio.imwrite(str(tmp_path / "new.aedat4"), np.zeros((4, 4), np.uint8),
                    plugin="pdavis")
