"""Videos and images of polarization cameras as recordings."""
import pickle
import re
from fractions import Fraction

import cv2
import numpy as np
import pytest
from images import encoded

import pdavis_cv as p
from pdavis_cv import Layout, RecordingError, VideoCapture, open_recording

SIZE = (20, 24)


def images(dtype, n=9, seed=0, top=None):
    top = np.iinfo(dtype).max if top is None else top
    return np.random.default_rng(seed).integers(
        0, top, (n, *SIZE), dtype, endpoint=True)


def write_video(path, frames, codec="ffv1", pixels=None):
    """Write 50 images a second."""
    return encoded(path, frames, codec, pixels or (
        "gray16le" if frames.dtype == np.uint16 else "gray"), base=Fraction(1, 50))


def frames_of(recording, *interval):
    return [packet.frames[0] for packet in recording.packets(*interval)]


def written(folder, dtype, kind):
    """Return a source of each kind and the images in it."""
    frames = images(dtype)
    if kind == "video":
        return write_video(folder / "clip.mkv", frames), frames
    if kind == "stack":
        assert cv2.imwritemulti(str(folder / "stack.tif"), list(frames))
        return folder / "stack.tif", frames
    for k, frame in enumerate(frames):
        assert cv2.imwrite(str(folder / f"shot_{k:03d}.png"), frame)
    return folder / ("shot_%03d.png" if kind == "pattern" else "shot_*.png"), frames


@pytest.mark.parametrize("kind", ["video", "stack", "pattern", "glob"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_every_image_arrives_unchanged(tmp_path, dtype, kind):
    source, expected = written(tmp_path, dtype, kind)
    fps = 50 if kind == "video" else 25
    with open_recording(source, layout=Layout.SONY) as recording:
        got = frames_of(recording)
        np.testing.assert_array_equal([f.dn for f in got], expected)
        times = [f.mid_us for f in got]
        assert times == [round(k * 1e6 / fps) for k in range(len(expected))]
        info = recording.info
        assert (info.sensor_size, info.layout) == (SIZE, Layout.SONY)
        assert (info.frame_count, info.event_count) == (len(expected), 0)
        assert (info.start_us, info.stop_us) == (0, times[-1] + 1)
        assert info.stop_us == recording.scan().stop_us
        assert got[0].full_scale_dn == np.iinfo(dtype).max
        assert got[0].exposure_ms == 0   # unknown, so that DN stay DN
        again = pickle.loads(pickle.dumps(recording))
        np.testing.assert_array_equal([f.dn for f in frames_of(again)], expected)


@pytest.mark.parametrize("kind", ["video", "stack", "pattern"])
def test_an_interval_is_a_part_of_the_whole(tmp_path, kind):
    source, expected = written(tmp_path, np.uint16, kind)
    recording = open_recording(source, layout=Layout.SONY, source_fps=30)
    whole = [f.mid_us for f in frames_of(recording)]
    for start, stop in [(None, 100_000), (33_333, 33_334), (33_334, None),
                        (66_667, 200_000), (10**9, None), (-5, 0), (-5, 1)]:
        got = frames_of(recording, start, stop)
        inside = [k for k, t in enumerate(whole)
                  if (start is None or t >= start) and (stop is None or t < stop)]
        assert [f.mid_us for f in got] == [whole[k] for k in inside]
        for f, k in zip(got, inside, strict=True):
            np.testing.assert_array_equal(f.dn, expected[k])


@pytest.mark.filterwarnings("ignore:.* loses detail")
@pytest.mark.parametrize(("codec", "pixels"), [
    ("ffv1", "gray"), ("mjpeg", "yuvj420p"), ("mpeg4", "yuv420p")])
def test_seeking_in_a_video_is_exact(tmp_path, codec, pixels):
    steps = np.linspace(0, 255, 40).astype(np.uint8)
    frames = np.stack([np.full(SIZE, step) for step in steps])
    path = write_video(tmp_path / "clip.avi", frames, codec, pixels)
    with VideoCapture(path, layout=Layout.SONY, output=p.CAP_PDAVIS_QUAD) as cap:
        known = [image.tobytes() for image in cap]
        assert len(known) == 40
        assert len(set(known)) >= 38
        for k in np.random.default_rng(0).integers(0, 40, 25):
            assert cap.set(1, k)
            assert cap.read()[1].tobytes() == known[k]


@pytest.mark.parametrize("codec", ["rawvideo", "ffv1"])
def test_images_that_an_avi_leaves_out_are_no_images(tmp_path, codec):
    expected = images(np.uint8, 4)
    path = encoded(tmp_path / "a.avi", expected, codec, "gray", [0, 1, 4, 5])
    with open_recording(path, layout="sony") as recording:
        frames, info = frames_of(recording), recording.info
        [last] = frames_of(recording, 160_001)
    np.testing.assert_array_equal([frame.dn for frame in frames], expected)
    assert [frame.mid_us for frame in frames] == [0, 40_000, 160_000, 200_000]
    assert (info.frame_count, info.stop_us) == (4, 200_001)
    np.testing.assert_array_equal(last.dn, expected[3])


def test_two_readers_of_a_video_get_the_same_images(tmp_path):
    expected = images(np.uint16, 3, top=4095)
    path = encoded(tmp_path / "a.nut", expected, "rawvideo", "gray12le")
    with open_recording(path, layout="sony") as recording:
        first, second = recording.packets(), recording.packets()
        for image in expected:
            for packets in first, second:
                np.testing.assert_array_equal(next(packets).frames[0].dn, image)


@pytest.mark.parametrize(("operation", "aop"), [
    (lambda a, layout: (a[1:], layout.crop(0, 1)), 0.4),
    (lambda a, layout: (a[:, 1:], layout.crop(1, 0)), 0.4),
    (lambda a, layout: (a[3:, 5:], layout.crop(5, 3)), 0.4),
    (lambda a, layout: (a[:, ::-1], layout.flip_x()), np.pi - 0.4),
    (lambda a, layout: (a[::-1], layout.flip_y()), np.pi - 0.4),
    (lambda a, layout: (np.rot90(a), layout.rot90()), 0.4 + np.pi / 2)],
    ids=["odd rows", "odd columns", "odd both", "mirror", "upside down", "turned"])
def test_cropped_and_mirrored_images_keep_their_polarization(tmp_path, operation, aop):
    # Light of AoP 0.4 and DoLP 0.7, the same everywhere.
    angles = np.deg2rad(np.tile(Layout.SONY.angles_deg, (10, 12)))
    mosaic = np.rint(2000 * (1 + 0.7 * np.cos(2 * (0.4 - angles)))).astype(np.uint16)
    changed, layout = operation(mosaic, Layout.SONY)
    cv2.imwrite(str(tmp_path / "one.png"), np.ascontiguousarray(changed))
    with VideoCapture(tmp_path / "one.png", layout=layout,
                      extinction_ratio=None) as cap:
        assert cap.grab()
        got = cap.retrieve(None, p.CAP_PDAVIS_AOP)[1]
        np.testing.assert_allclose(got, aop, atol=1e-3)
        dolp = cap.retrieve(None, p.CAP_PDAVIS_DOLP)[1]
        np.testing.assert_allclose(dolp, 0.7, atol=1e-3)


def test_twelve_bits_in_sixteen_are_known_by_their_size(tmp_path):
    path = write_video(tmp_path / "clip.mkv", images(np.uint16, top=4095))
    recording = open_recording(path, layout=Layout.SONY)
    assert {f.full_scale_dn for f in frames_of(recording)} == {4095}
    with VideoCapture(recording) as cap:
        assert cap.get(p.CAP_PROP_PDAVIS_WHITE) == 4095


def test_colour_video_of_grey_is_grey(tmp_path):
    frames = images(np.uint8)
    writer = cv2.VideoWriter(
        str(tmp_path / "c.avi"), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), 10,
        SIZE[::-1])
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()
    recording = open_recording(tmp_path / "c.avi", layout=Layout.SONY)
    got = [f.dn for f in frames_of(recording)]
    # FFV1 keeps BGR only through a YUV of its own: within one count.
    assert np.abs(np.array(got) - frames).max() <= 1


def test_what_is_not_a_grey_image_is_refused(tmp_path):
    colour = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "colour.png"), colour)
    for name in ("junk.png", "junk.tif", "junk.mkv"):
        (tmp_path / name).write_bytes(b"\0 no image")
    (tmp_path / "text.png").write_text("no image")
    cases = {
        "colour.png": "the image must be grey, got 3 channels",
        "junk.png": "cannot be decoded", "junk.mkv": "not a video",
        "junk.tif": "not a TIFF", "text.png": "text, but no lines of events",
        "none.png": "no such file", "none_%02d.png": "no such file",
        "none_*.png": "no such file", "": "a folder, give a pattern"}
    for name, reason in cases.items():
        with pytest.raises(RecordingError, match=re.escape(reason)):
            open_recording(tmp_path / name, layout=Layout.SONY)


def test_images_of_different_sizes_are_refused_where_they_differ(tmp_path):
    for k, size in enumerate([SIZE, SIZE, (10, 10)]):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.zeros(size, np.uint8))
    recording = open_recording(tmp_path / "%d.png", layout=Layout.SONY)
    with pytest.raises(RecordingError, match="image 2 is 10x10, the first one is 24"):
        list(recording.packets())
    with VideoCapture(tmp_path / "%d.png", layout=Layout.SONY) as cap:
        assert [cap.read()[0] for _ in range(4)][-1] is False
        assert cap.status == p.CaptureStatus.ERROR
        assert "image 2 is 10x10" in cap.last_error


def test_a_missing_layout_is_asked_for(tmp_path):
    path = write_video(tmp_path / "clip.mkv", images(np.uint8))
    with pytest.raises(RecordingError, match="layout="):
        open_recording(path)


@pytest.mark.gate
def test_a_camera_image_agrees_with_an_independent_computation(data_dir):
    """Bilinear interpolation by correlation with the classical kernels, in float64."""
    path = data_dir / "camera_IMX250MZR.png"
    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(float)
    height, width = raw.shape
    kernel = np.outer([0.5, 1, 0.5], [0.5, 1, 0.5])
    quad = {}
    for angle, row, column in ((90, 0, 0), (45, 0, 1), (135, 1, 0), (0, 1, 1)):
        alone = np.zeros_like(raw)
        alone[row::2, column::2] = raw[row::2, column::2]
        quad[angle] = cv2.filter2D(alone, -1, kernel, borderType=cv2.BORDER_CONSTANT)
    s0 = (quad[0] + quad[45] + quad[90] + quad[135]) / 2
    er = 351 / 349
    s1, s2 = (quad[0] - quad[90]) * er, (quad[45] - quad[135]) * er
    inner = (slice(2, height - 2), slice(2, width - 2))
    with VideoCapture(path, layout=Layout.SONY) as cap:
        assert (cap.get(7), cap.get(3), cap.get(4)) == (1, width, height)
        assert cap.grab()

        def plane(flag):
            return cap.retrieve(None, flag)[1][inner].astype(float)
        for flag, angle in ((p.CAP_PDAVIS_I0, 0), (p.CAP_PDAVIS_I45, 45),
                            (p.CAP_PDAVIS_I90, 90), (p.CAP_PDAVIS_I135, 135)):
            # Dark pixels are floored at one count before their logarithm.
            lit = quad[angle][inner] >= 4
            np.testing.assert_allclose(
                plane(flag)[lit], quad[angle][inner][lit], rtol=2e-5, atol=1.0)
        usable = cap.retrieve(None, p.CAP_PDAVIS_VALID)[1][inner] > 0
        assert usable.mean() > 0.5
        np.testing.assert_allclose(
            plane(p.CAP_PDAVIS_S0)[usable], s0[inner][usable], rtol=1e-4)
        dolp = np.hypot(s1, s2) / s0
        np.testing.assert_allclose(
            plane(p.CAP_PDAVIS_DOLP)[usable], dolp[inner][usable], atol=2e-4)
        aop = np.arctan2(s2, s1)[inner] / 2
        error = np.angle(np.exp(2j * (plane(p.CAP_PDAVIS_AOP) - aop))) / 2
        clear = usable & (np.hypot(s1, s2)[inner] > 1)
        assert np.abs(error[clear]).max() < 2e-3
        assert not cap.read()[0]


@pytest.mark.parametrize("name", ["camera", "fruits"])
def test_no_pixel_of_a_real_mosaic_at_full_scale_counts(name, data_dir):
    path = data_dir / f"{name}_IMX250MZR.png"
    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    full = (raw == 255).reshape(1024, 2, 1224, 2).any((1, 3))
    assert full.any()
    with open_recording(path, layout=Layout.SONY) as recording:
        image, = p.fuse(recording, demosaic="superpixel")
    assert not image.valid[full].any()
    assert image.valid[~full].mean() > 0.5


@pytest.mark.filterwarnings("ignore:.* loses detail")
@pytest.mark.parametrize("marker", [b"\xff\xe0", b"\xff\xdb", b"\xff\xc0"])
def test_bytes_may_fill_up_before_a_marker_of_jpeg(tmp_path, marker):
    image = np.arange(64, dtype=np.uint8).reshape(8, 8)
    data = cv2.imencode(".jpg", image)[1].tobytes()
    (tmp_path / "a.jpg").write_bytes(data)
    (tmp_path / "b.jpg").write_bytes(data.replace(marker, b"\xff\xff" + marker, 1))
    one, other = (open_recording(tmp_path / name, layout="sony")
                  for name in ("a.jpg", "b.jpg"))
    np.testing.assert_array_equal(frames_of(one)[0].dn, frames_of(other)[0].dn)
