"""Images of other writers: what they state, and four planes of each time."""
import contextlib
import json
import re
import shutil
import warnings
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
import tifffile
from images import encoded

import pdavis_cv as p
from pdavis_cv import (
    Layout,
    PdavisWarning,
    RecordingError,
    VideoCapture,
    fuse,
    open_recording,
)
from pdavis_cv.recording.facts import ASSUMED, CALLER, FILE, MEASURED, Fact
from pdavis_cv.recording.images.checks import found_colours, measured_full_scale
from pdavis_cv.recording.images.names import by_angle, natural_order

SONY = Layout.SONY
SIZE = (32, 40)


def frames_of(recording, *interval):
    return [frame for packet in recording.packets(*interval)
            for frame in packet.frames]


def read(source, layout=SONY, **options):
    """Return the frames, and the facts."""
    with open_recording(source, layout=layout, **options) as recording:
        return frames_of(recording), recording.info


def quads(n, size=SIZE, top=4000.0):
    """Return I0, I45, I90, I135 of n times, uint16: AoP 20 + 5 k degrees, DoLP .5."""
    y, x = np.mgrid[:size[0], :size[1]]
    s0 = top * (0.5 + 0.3 * np.sin(x / 7) * np.cos(y / 5))
    return np.stack([np.rint([
        s0 / 2 * (1 + 0.5 * np.cos(2 * np.deg2rad(20 + 5 * k - angle)))
        for angle in p.CHANNELS]) for k in range(n)]).astype(np.uint16)


def mosaics(n, size=SIZE, top=4000.0, layout=SONY):
    """Return the mosaics of `quads`, shape (n, H, W)."""
    out = np.empty((n, *size), np.uint16)
    for place, channel in zip(layout.places, range(4), strict=True):
        part = np.s_[:, place // 2::2, place % 2::2]
        out[part] = quads(n, size, top)[:, channel][part]
    return out


@pytest.fixture(scope="module")
def public(data_dir):
    """Return the folder of files that users bring."""
    if not (data_dir / "public").is_dir():
        pytest.skip("PDAVIS_TEST_DATA has no folder public")
    return data_dir / "public"


# ---- TIFF --------------------------------------------------------------------


def micro_manager(path, images):
    with tifffile.TiffWriter(path) as tiff:
        for k, image in enumerate(images):
            about = json.dumps({"ElapsedTime-ms": 70 + 12.5 * k, "Exposure-ms": 4,
                                "BitDepth": 12})
            tiff.write(image, contiguous=False, metadata=None,
                       extratags=[(51123, 2, None, about, True)])


def delta_t(path, images):
    planes = {"DeltaT": [5.0 + 12.5 * k for k in range(len(images))],
              "DeltaTUnit": ["ms"] * len(images)}
    tifffile.imwrite(path, images, ome=True, metadata={
        "axes": "TYX", "Plane": planes, "SignificantBits": 12})


def pages(path, images, **options):
    with tifffile.TiffWriter(path) as tiff:
        for image in images:
            tiff.write(image, contiguous=False, **options)


STATED = {
    "ome": lambda f, a: tifffile.imwrite(f, a, ome=True, metadata={
        "axes": "TYX", "TimeIncrement": 12500, "TimeIncrementUnit": "µs",
        "SignificantBits": 12}),
    "ome plane": delta_t,
    "imagej": lambda f, a: tifffile.imwrite(f, a, imagej=True, metadata={
        "axes": "TYX", "finterval": 0.0125}),
    "imagej slices": lambda f, a: tifffile.imwrite(f, a, imagej=True, metadata={
        "axes": "ZYX", "finterval": 12.5, "tunit": "ms"}),
    "imagej without axes": lambda f, a: tifffile.imwrite(f, a, imagej=True, metadata={
        "finterval": 0.0125}),
    "micro-manager": micro_manager}
NOT_STATED = {
    "plain": tifffile.imwrite,
    "big, big-endian": lambda f, a: tifffile.imwrite(
        f, a, bigtiff=True, byteorder=">"),
    "float": lambda f, a: tifffile.imwrite(f, a.astype(np.float32)),
    "packed": lambda f, a: tifffile.imwrite(f, a, compression="zlib", predictor=True),
    "pages": lambda f, a: pages(f, a, metadata=None),
    "pages with metadata": pages,
    "tiles": lambda f, a: tifffile.imwrite(f, a, tile=(16, 16)),
    "cv2": lambda f, a: cv2.imwritemulti(str(f), list(a))}


@pytest.mark.parametrize("kind", STATED)
def test_times_that_a_tiff_states_are_read(tmp_path, kind):
    expected = mosaics(9)
    STATED[kind](tmp_path / "stack.tif", expected)
    frames, info = read(tmp_path / "stack.tif")
    np.testing.assert_array_equal([frame.dn for frame in frames], expected)
    assert [frame.exposure_start_us for frame in frames] == [
        12500 * k for k in range(9)]
    assert info.frame_count == 9
    assert info.facts["frame_times"].origin == FILE
    assert info.facts["full_scale_dn"].origin == (
        ASSUMED if kind.startswith("imagej") else FILE)
    assert info.exposure_us == (4000 if kind == "micro-manager" else None)
    assert {frame.full_scale_dn for frame in frames} == {4095}
    # An interval is a part of the whole.
    assert [frame.available_us for frame in frames_of(
        open_recording(tmp_path / "stack.tif", layout=SONY), 30_000, 70_000)] == [
            frame.available_us for frame in frames
            if 30_000 <= frame.available_us < 70_000]


@pytest.mark.parametrize("kind", NOT_STATED)
def test_every_kind_of_tiff_is_read(tmp_path, kind):
    expected = mosaics(9)
    NOT_STATED[kind](tmp_path / "stack.tif", expected)
    frames, info = read(tmp_path / "stack.tif")
    np.testing.assert_array_equal([frame.dn for frame in frames], expected)
    assert info.stop_us == 8 * 40_000 + 1
    assert info.facts["frame_times"] == Fact(25.0, ASSUMED)
    frames, info = read(tmp_path / "stack.tif", source_fps=100)
    assert info.facts["frame_times"] == Fact(100, CALLER)
    assert [frame.mid_us for frame in frames] == [10_000 * k for k in range(9)]


def test_files_of_micro_manager_are_one_recording_with_its_times(tmp_path):
    expected = mosaics(11)
    for k, image in enumerate(expected):
        about = json.dumps({"ElapsedTime-ms": 100 + 7 * k, "Exposure-ms": 2.0})
        tifffile.imwrite(tmp_path / f"img_{k}.tif", image, metadata=None,
                         extratags=[(51123, 2, None, about, True)])
    frames, info = read(tmp_path / "img_*.tif")
    np.testing.assert_array_equal([frame.dn for frame in frames], expected)
    assert [frame.exposure_start_us for frame in frames] == [
        7000 * k for k in range(11)]
    assert info.exposure_us == 2000


def test_an_ome_tiff_of_several_files_is_one_recording(tmp_path):
    expected = mosaics(6)

    def about(me):
        data = "".join(
            f'<TiffData FirstT="{t}" FirstC="0" FirstZ="0" IFD="{t % 3}" '
            f'PlaneCount="1"><UUID FileName="s_{t // 3}.ome.tif">urn:uuid:{t // 3}'
            "</UUID></TiffData>" for t in range(6))
        return (
            '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/'
            f'OME/2016-06" UUID="urn:uuid:{me}"><Image ID="Image:0"><Pixels '
            'ID="Pixels:0" DimensionOrder="XYZCT" Type="uint16" SizeX="40" SizeY="32" '
            'SizeZ="1" SizeC="1" SizeT="6" TimeIncrement="10" TimeIncrementUnit="ms">'
            f'<Channel ID="Channel:0:0" SamplesPerPixel="1"/>{data}</Pixels></Image>'
            "</OME>")

    for me in (0, 1):
        with tifffile.TiffWriter(tmp_path / f"s_{me}.ome.tif") as tiff:
            for k in range(3):
                tiff.write(expected[3 * me + k], contiguous=False, metadata=None,
                           description=about(me) if k == 0 else None)
    frames, _ = read(tmp_path / "s_0.ome.tif")
    np.testing.assert_array_equal([frame.dn for frame in frames], expected)
    assert frames[-1].mid_us == 50_000


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("kind", ["ome", "imagej", "packed", "video"])
def test_damage_is_an_error_of_one_kind(tmp_path, kind, seed):
    if kind == "video":
        path = encoded(tmp_path / "a.mkv", mosaics(5, top=4095), "ffv1", "gray12le")
    else:
        path = tmp_path / "a.tif"
        {**STATED, **NOT_STATED}[kind](path, mosaics(5))
    rng, data = np.random.default_rng(seed), bytearray(path.read_bytes())
    if seed < 4:
        data = data[:int(rng.integers(len(data)))]
    for at in rng.integers(0, max(len(data), 1), 20 if seed >= 4 else 0):
        data[at] = int(rng.integers(256))
    path.write_bytes(data)
    frames = []
    with warnings.catch_warnings(), contextlib.suppress(RecordingError):
        warnings.simplefilter("ignore", PdavisWarning)
        frames, _ = read(path)
    assert all(frame.shape == frames[0].shape for frame in frames)


def test_a_hyperstack_is_refused_with_what_to_do(tmp_path):
    tifffile.imwrite(tmp_path / "h.tif", np.zeros((5, 3, *SIZE), np.uint16),
                     imagej=True, metadata={"axes": "TZYX"})
    with pytest.raises(RecordingError, match="5 times with 3 slices each; save one"):
        read(tmp_path / "h.tif")
    tifffile.imwrite(tmp_path / "c.tif", np.zeros((5, 2, *SIZE), np.uint16),
                     imagej=True, metadata={"axes": "TCYX"})
    with pytest.raises(RecordingError, match="2 channels at each time; save"):
        read(tmp_path / "c.tif")


def test_numbers_from_0_to_1_are_scaled(tmp_path):
    tifffile.imwrite(tmp_path / "unit.tif", (mosaics(2) / 4095).astype(np.float32))
    frames, _ = read(tmp_path / "unit.tif")
    np.testing.assert_allclose(frames[1].dn, mosaics(2)[1] / 4095 * 65535, rtol=1e-6)
    with open_recording(tmp_path / "unit.tif", layout=SONY) as recording:
        image = next(fuse(recording, extinction_ratio=None, demosaic="superpixel"))
    np.testing.assert_allclose(np.rad2deg(np.median(image.aop)), 20, atol=1)


# ---- video -------------------------------------------------------------------


@pytest.mark.parametrize(("name", "codec", "pixels", "bits"), [
    ("a.mkv", "ffv1", "gray", 8), ("a.mkv", "ffv1", "gray10le", 10),
    ("a.avi", "ffv1", "gray12le", 12), ("a.nut", "rawvideo", "gray14le", 14),
    ("a.mkv", "ffv1", "gray16le", 16)])
def test_all_bits_of_a_lossless_video_are_read(tmp_path, name, codec, pixels, bits):
    top = (1 << bits) - 1
    expected = mosaics(5, top=top).astype(np.uint16 if bits > 8 else np.uint8)
    frames, info = read(encoded(tmp_path / name, expected, codec, pixels))
    np.testing.assert_array_equal([frame.dn for frame in frames], expected)
    assert frames[0].full_scale_dn == top
    # Without an index, counting raw images is reading them.
    assert info.frame_count == (None if name == "a.nut" else 5)
    assert [frame.mid_us for frame in frames] == [40_000 * k for k in range(5)]


@pytest.mark.parametrize(("name", "codec", "pixels", "bits", "word"), [
    ("a.mkv", "libx265", "gray12le", 12, "HEVC"),
    ("a.mkv", "libx264", "gray10le", 10, "H.264"),
    ("a.mp4", "libx264", "yuv420p", 8, "H.264"), ("a.mpg", "mpeg2video", "yuv420p", 8,
                                                  "MPEG-2"),
    ("a.avi", "mjpeg", "yuvj420p", 8, "MJPEG"), ("a.ts", "mpeg2video", "yuv420p", 8,
                                                 "MPEG-2")])
def test_a_lossy_codec_is_read_to_its_end_and_named(
        tmp_path, name, codec, pixels, bits, word):
    size, top = (96, 128), (1 << bits) - 1
    y, x = np.mgrid[:size[0], :size[1]]
    smooth = top * (0.3 + 0.4 * x / size[1] + 0.1 * y / size[0])
    images = np.broadcast_to(np.rint(smooth), (30, *size)).astype(
        np.uint16 if bits > 8 else np.uint8)
    path = encoded(tmp_path / name, images, codec, pixels)
    with pytest.warns(PdavisWarning, match=f"codec {word}.* loses detail") as said:
        recording = open_recording(path, layout=SONY)
    assert len(said) == 1
    frames = frames_of(recording)
    assert len(frames) == recording.scan().frame_count == 30
    assert frames[0].full_scale_dn == top
    # MPEG's clock starts at .54 s: a recording at 0.
    assert [frame.mid_us for frame in frames] == [40_000 * k for k in range(30)]
    for frame in frames:
        assert np.abs(frame.dn - smooth).mean() < 0.02 * top


def test_lossless_h264_is_not_lossy(tmp_path):
    expected = mosaics(4, top=250).astype(np.uint8)
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"qp": "0"})
        stream.height, stream.width, stream.pix_fmt = *SIZE, "gray"
        for k, image in enumerate(expected):
            frame = av.VideoFrame.from_ndarray(image, format="gray")
            frame.pts = k
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    frames, _ = read(path)
    np.testing.assert_array_equal([frame.dn for frame in frames], expected)


@pytest.mark.parametrize("name", ["a.mkv", "a.mp4"])
def test_times_of_a_variable_rate_are_the_container_s(tmp_path, name):
    times = [0, 40, 80, 500, 520, 1500]
    path = encoded(tmp_path / name, mosaics(6, top=255).astype(np.uint8), "ffv1",
                   "gray", times, Fraction(1, 1000))
    frames, info = read(path)
    assert [frame.mid_us for frame in frames] == [1000 * t for t in times]
    assert info.stop_us == 1_500_001
    with open_recording(path, layout=SONY) as recording:
        assert [f.mid_us for f in frames_of(recording, 80_001, 520_000)] == [500_000]
    frames, _ = read(path, source_fps=50)
    assert frames[-1].mid_us == 100_000


@pytest.mark.parametrize(("name", "codec"), [
    ("a.mjpeg", "mjpeg"), ("a.h264", "libx264")])
def test_a_bare_stream_states_no_rate(tmp_path, name, codec):
    path = encoded(tmp_path / name, np.full((5, *SIZE), 90, np.uint8), codec,
                 "yuvj420p" if codec == "mjpeg" else "yuv420p")
    with pytest.warns(PdavisWarning, match="loses detail"):
        frames, info = read(path)
    assert info.facts["frame_times"] == Fact(25.0, ASSUMED)
    assert [frame.mid_us for frame in frames] == [40_000 * k for k in range(5)]
    with pytest.warns(PdavisWarning, match="loses detail"):
        frames, info = read(path, source_fps=100)
    assert info.facts["frame_times"] == Fact(100, CALLER)
    assert frames[-1].mid_us == 40_000


def test_a_colour_video_is_refused(tmp_path):
    path = tmp_path / "c.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.height, stream.width, stream.pix_fmt = *SIZE, "yuv420p"
        noise = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), np.uint8)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(noise, format="rgb24")))
        container.mux(stream.encode(None))
    with pytest.raises(RecordingError, match="must be grey, got colour"):
        read(path)


# ---- stills, names, full scale -----------------------------------------------


@pytest.mark.parametrize("folder", ["100% pol", "a [1]", "%d of %s", "plain"])
@pytest.mark.parametrize("first", [0, 1, 4])
def test_patterns_are_numbers_of_files_in_any_folder(tmp_path, folder, first):
    here = tmp_path / folder
    here.mkdir()
    for k in range(first, first + 12):
        cv2.imwrite(str(here / f"shot_{k}.png"), np.full(SIZE, k, np.uint8))
    for pattern in ("shot_%d.png", "shot_*.png", "shot_?*.png"):
        frames, _ = read(here / pattern)
        assert [int(frame.dn[0, 0]) for frame in frames] == [
            *range(first, first + 12)]
    capture = VideoCapture(str(here / "shot_%d.png"), layout=SONY)
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == 12


@pytest.mark.parametrize("name", ["no_%04d.png", "no%.png", "%", "%s", "no_[*.png",
                                  "none/%d.png", "no**.png", "**", "no[1", "no%99d.x",
                                  300 * "x"])
def test_a_name_without_files_is_false_and_not_an_exception(tmp_path, name):
    capture = VideoCapture(str(tmp_path / name), layout=SONY)
    assert not capture.isOpened()
    assert re.search("no such file|name too long", capture.last_error.lower())
    with pytest.raises(RecordingError, match=r"cannot be opened"):
        open_recording(tmp_path / name)


@pytest.mark.parametrize("name", ["a\0b.png", "a\0.aedat4", "a\0%04d.png"])
@pytest.mark.parametrize("given", [{}, {"layout": SONY}])
def test_a_null_character_is_refused_by_name(name, given):
    with pytest.raises(RecordingError, match="cannot hold a null character"):
        open_recording(name, **given)
    with pytest.raises(RecordingError, match="cannot hold a null character"):
        open_recording([name, name], **given)
    assert not VideoCapture(name, **given).isOpened()


def test_a_pattern_of_a_number_that_no_name_holds_is_refused_at_once():
    capture = VideoCapture("%999999999d.png")   # FFmpeg takes 16 s
    assert not capture.isOpened()
    assert "no file has so long a number" in capture.last_error


def test_natural_order_is_that_of_numbers():
    assert natural_order(["a10", "a9", "b1", "a1x2", "a1x10", "7"]) == [
        "7", "a1x2", "a1x10", "a9", "a10", "b1"]


@pytest.mark.parametrize(("top", "step"), [
    (1023, 1), (4095, 1), (1023, 64), (4095, 16), (16383, 4), (65535, 1)])
def test_full_scale_is_measured_where_samples_are_clipped(tmp_path, top, step):
    dn = np.minimum(mosaics(1, top=2 * top)[0] if top < 30000 else
                    mosaics(1, top=65535)[0] * 2.0, top).astype(np.uint16) * step
    cv2.imwrite(str(tmp_path / "one.png"), dn)
    frames, _ = read(tmp_path / "one.png")
    assert frames[0].full_scale_dn == top * step
    frames, _ = read(tmp_path / "one.png", full_scale_dn=60000)
    assert frames[0].full_scale_dn == 60000
    assert measured_full_scale([np.minimum(dn, top * step - step - 1)]) is None


@pytest.mark.parametrize("head", [
    b"P5\n# a camera\n%d %d\n1023\n", b"P2\n%d %d\n1023\n", b"P2 %d %d 1023\n"])
def test_the_maximum_of_a_pgm_is_its_full_scale(tmp_path, head):
    image = mosaics(1, top=900)[0].astype(np.uint16)
    rows = "\n".join(" ".join(map(str, row)) for row in image) + "\n"
    (tmp_path / "a.pgm").write_bytes(head % SIZE[::-1] + (
        rows.encode() if head[1:2] == b"2" else image.astype(">u2").tobytes()))
    frames, _ = read(tmp_path / "a.pgm")
    np.testing.assert_array_equal(frames[0].dn, image)
    assert frames[0].full_scale_dn == 1023


@pytest.mark.parametrize("seed", range(5))
def test_noise_and_steps_are_not_colour(seed):
    rng = np.random.default_rng(seed)
    assert found_colours(rng.integers(0, 4096, SIZE, np.uint16)) is None
    steps = np.kron(rng.integers(50, 4000, (8, 10)), np.ones((7, 9), int))
    assert found_colours(steps.astype(np.uint16)) is None


# ---- four planes of each time ------------------------------------------------


def four_files(folder, quads, suffix=".png", name="t{k}_I{angle}"):
    for k, planes in enumerate(quads):
        for angle, plane in zip(p.CHANNELS, planes, strict=True):
            cv2.imwrite(str(folder / (name.format(k=k, angle=angle) + suffix)), plane)
    return folder / f"*{suffix}"


def four_stacks(folder, quads):
    for angle, planes in zip(p.CHANNELS, np.swapaxes(quads, 0, 1), strict=True):
        tifffile.imwrite(folder / f"pol_{angle:03d}.tif", planes,
                         photometric="minisblack")
    return folder / "pol_*.tif"


def saved(name, save, *axes, **options):
    def write(folder, quads):
        save(folder / name, np.transpose(quads, axes or (0, 1, 2, 3)), **options)
        return folder / name
    return write


TIMED = {"axes": "TCYX", "finterval": 0.04}
FOUR = {
    "npy": saved("a.npy", np.save),
    "files": four_files,
    "stacks": four_stacks,
    "imagej": saved("a.tif", tifffile.imwrite, imagej=True, metadata=TIMED),
    "ome": saved("a.ome.tif", tifffile.imwrite, metadata={"axes": "TCYX"}),
    "ome, channels first": saved("a.ome.tif", tifffile.imwrite, 1, 0, 2, 3,
                                 metadata={"axes": "CTYX"}),
    "samples": saved("a.tif", tifffile.imwrite, 0, 2, 3, 1, photometric="minisblack",
                     planarconfig="contig", compression="zlib"),
    "planes": saved("a.tif", tifffile.imwrite, photometric="minisblack")}


@pytest.mark.parametrize("layout", [None, SONY])
@pytest.mark.parametrize("kind", FOUR)
def test_four_planes_are_the_channels_as_they_are(tmp_path, kind, layout):
    expected = quads(3)
    source = FOUR[kind](tmp_path, expected)
    with open_recording(source, layout=layout) as recording:
        images = list(fuse(recording, extinction_ratio=None))
        assert recording.info.frame_count == 3
    assert [image.t_us for image in images] == [0, 40_000, 80_000]
    for image, planes in zip(images, expected, strict=True):
        np.testing.assert_allclose(image.quad, planes, rtol=1e-5)
    for k, image in enumerate(images):
        np.testing.assert_allclose(np.rad2deg(image.aop), 20 + 5 * k, atol=0.3)
        assert image.valid.all()
    with VideoCapture(str(source), layout=layout, output="i45") as capture:
        assert capture.get(cv2.CAP_PROP_FRAME_WIDTH) == SIZE[1]
        assert capture.set(cv2.CAP_PROP_POS_FRAMES, 2)
        np.testing.assert_allclose(capture.read()[1], expected[2, 1], rtol=1e-5)


@pytest.mark.parametrize("kind", ["one array", "four files"])
def test_one_time_of_four_planes(tmp_path, kind):
    if kind == "one array":
        np.save(tmp_path / "a.npy", quads(1)[0])
        source = tmp_path / "a.npy"
    else:
        source = four_files(tmp_path, quads(1), ".tif", "I{angle}")
    frames, info = read(source, None)
    assert len(frames) == info.frame_count == 1


def test_four_files_in_a_list_are_four_planes_and_others_need_a_layout(tmp_path):
    four_files(tmp_path, quads(1))
    source = [str(path) for path in sorted(tmp_path.iterdir())]
    with VideoCapture(source, output="i135") as capture:
        np.testing.assert_allclose(capture.read()[1], quads(1)[0, 3], rtol=1e-5)
    capture = VideoCapture(source[:3])
    assert not capture.isOpened()
    assert 'layout="sony"' in capture.last_error
    with pytest.raises(cv2.error, match="opened by no backend of cv2"):
        VideoCapture(source, cv2.CAP_FFMPEG)


def test_arrays_of_mosaics_need_a_layout(tmp_path):
    np.save(tmp_path / "a.npy", mosaics(6))
    frames, _ = read(tmp_path / "a.npy")
    np.testing.assert_array_equal([frame.dn for frame in frames], mosaics(6))
    with pytest.raises(RecordingError, match="need its layout"):
        read(tmp_path / "a.npy", None)
    np.save(tmp_path / "one.npy", mosaics(1)[0])
    frames, _ = read(tmp_path / "one.npy")
    np.testing.assert_array_equal([frame.dn for frame in frames], mosaics(1))
    np.save(tmp_path / "f.npy", np.asfortranarray(mosaics(6)))
    with pytest.raises(RecordingError, match="column by column"):
        read(tmp_path / "f.npy")


def test_files_are_four_planes_only_if_all_are():
    four = [f"run1/a_{angle}.png" for angle in p.CHANNELS]
    assert by_angle([*reversed(four)]) == [[name] for name in four]
    assert by_angle(four[:3]) is None
    assert by_angle([*four, "run1/a_5.png"]) is None
    folders = [f"I{angle}/{k}.png" for k in (10, 9) for angle in p.CHANNELS]
    assert by_angle(folders)[1] == ["I45/9.png", "I45/10.png"]


# ---- files that users bring --------------------------------------------------


def test_public_stacks(public):
    for name, count, sums, row in (
            ("stack_50fps.ome.tif", 100, None, [878, 1061, 850, 1153]),
            ("imagej_single_ifd.tif", 40, (3_053_490, 3_088_852),
             [540, 742, 602, 819]),
            ("slow_stack_500.tif", 500, (533_611, 516_105), [3402, 2547, 2044, 1079])):
        frames, info = read(public / name)
        assert len(frames) == info.frame_count == count
        step = 40_000 if name.startswith("slow") else 20_000
        assert [frame.mid_us for frame in frames] == [step * k for k in range(count)]
        np.testing.assert_array_equal(frames[0].dn[0, :4], row)
        if sums:
            assert (frames[0].dn.sum(dtype=float),
                    frames[-1].dn.sum(dtype=float)) == sums


def test_public_videos(public):
    frames, _ = read(public / "g12.mkv")
    assert [frame.mid_us for frame in frames] == [40_000 * k for k in range(10)]
    assert frames[0].full_scale_dn == 4095
    assert frames[0].dn.sum(dtype=float) == 12_250_308
    with open_recording(public / "g12.mkv", layout=SONY) as recording:
        aop = [np.rad2deg(image.aop[64, 80])
               for image in fuse(recording, extinction_ratio=None)]
    np.testing.assert_allclose(aop, 60 + 5 * np.arange(10), atol=0.1)
    frames, _ = read(public / "vfr.mkv")
    assert [frame.mid_us // 1000 for frame in frames] == [
        0, 40, 80, 120, 160, 660, 700, 740, 780, 820]
    assert frames[0].dn.sum(dtype=float) == 756_016
    with pytest.warns(PdavisWarning, match=r"real_mjpg.avi: codec MJPEG"):
        frames, _ = read(public / "real_mjpg.avi")
    assert len(frames) == 3


def test_public_stills(public, tmp_path):
    with open_recording(public / "mono10_saturated.png", layout=SONY) as recording:
        image, = fuse(recording, extinction_ratio=None)
        assert frames_of(recording)[0].full_scale_dn == 1023
        assert recording.info.facts["full_scale_dn"] == Fact(1023, MEASURED)
    assert (~image.valid).mean() == pytest.approx(0.485, abs=0.005)
    y, x = np.mgrid[:128, :160]
    inner = image.valid & (np.minimum(y, 127 - y) > 1) & (np.minimum(x, 159 - x) > 1)
    off = np.angle(np.exp(2j * (image.aop - np.deg2rad(30 + 60 * x / 160)))) / 2
    assert np.median(np.abs(np.rad2deg(off[inner]))) < 0.4
    assert np.median(np.abs((image.dolp - (0.2 + 0.6 * y / 128))[inner])) < 0.004
    with open_recording(
            public / "imx250myr_colour.png", layout="sony-rggb") as recording:
        image, = fuse(recording, extinction_ratio=None)
    for one in (image, *image.colours.values()):
        off = np.angle(np.exp(2j * (one.aop - np.deg2rad(30 + 60 * x / 160)))) / 2
        assert np.median(np.abs(np.rad2deg(off))) < 0.1
        assert np.median(np.abs(one.dolp - (0.2 + 0.6 * y / 128))) < 0.001
    with open_recording(public / "natural_sort" / "shot_*.png", layout=SONY) as twelve:
        aop = [np.rad2deg(image.aop[64, 2])
               for image in fuse(twelve, extinction_ratio=None)]
    np.testing.assert_allclose(aop, 35.8 + 5 * np.arange(12), atol=0.06)
    for pattern in ("shot_%04d.png", "shot_*.png"):
        frames, _ = read(public / "100% pol" / pattern)
        assert [frame.dn.sum(dtype=float) for frame in frames] == [12_248_703]
    frames, _ = read(public / "start3" / "shot_%04d.png")
    assert [frame.dn.sum(dtype=float) for frame in frames] == [12_249_188, 12_251_228]
    shutil.copy(public / "start3" / "shot_0003.png", tmp_path / "shot_0005.png")
    assert not VideoCapture(tmp_path / "shot_%04d.png", layout=SONY).isOpened()
