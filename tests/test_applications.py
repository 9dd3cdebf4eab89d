"""pdavis fan and pdavis tendon, on simulated recordings with known truth."""
import json
import re
import signal
import warnings

import numpy as np
import pytest
from streams import opens_by

from pdavis_cv import (
    EVENT_DTYPE,
    ApsFrame,
    Layout,
    PolarFrame,
    fuse,
    open_recording,
    recording_from_arrays,
)
from pdavis_cv.data import example_recording
from pdavis_cv.export import read_embedded
from pdavis_cv.simulation import Camera, Fan, Tendon
from pdavis_cv.tools import export, fan
from pdavis_cv.tools._images import grid_times
from pdavis_cv.tools.tendon import command as tendon

cv2 = pytest.importorskip("cv2")


def wheel_at(rpm):
    scene = Fan(rpm=rpm, bright=4.0, s0=9.0, radius=28, hub=8,
                centre=(172.37, 129.61))
    camera = Camera.preset("ideal", size=(64, 72))
    # The wheel's axis is given on the sensor; the camera sees a part of it.
    recording, _ = camera.record(scene, 0.05 + 40 / rpm)
    y0, x0 = camera.origin
    return recording, (172.37 - x0, 129.61 - y0)


@pytest.fixture(scope="module")
def wheel():
    return wheel_at(200.0)


@pytest.fixture(scope="module")
def pulled():
    scene = Tendon(hz=5.0)
    recording, truth = Camera.preset("ideal", size=(24, 32)).record(scene, 2.0)
    return recording, truth, scene


def opener(recordings):
    return lambda path, *facts, **options: recordings[str(path)]


@pytest.mark.parametrize(("rpm", "method"), [
    (200.0, "cf"), pytest.param(1000.0, "kalman", marks=pytest.mark.gate)])
def test_fan_measures_what_the_images_say_and_writes_the_video(
        tmp_path, wheel, monkeypatch, capsys, rpm, method):
    recording, (x, y) = wheel if rpm == 200 else wheel_at(rpm)
    opens_by(monkeypatch, opener({"a": recording}))
    out = tmp_path / "fan.webm"
    assert fan.main(["a", "-o", str(out), "--fps", "50", "--slow", "5", "--centre",
                     f"{x},{y}", "--radius", "24", "--hub", "12", "--rpm", str(rpm),
                     "--method", method, "--still", str(tmp_path / "s.png")]) == 0
    text = capsys.readouterr().out
    reader = cv2.VideoCapture(str(out))
    count, rate = reader.get(cv2.CAP_PROP_FRAME_COUNT), reader.get(cv2.CAP_PROP_FPS)
    size = int(reader.get(3)), int(reader.get(4))
    reader.release()
    assert f"{count:.0f} pictures of {size[0]}x{size[1]}, 10 per second" in text
    assert rate == 10
    assert size[0] % 2 == size[1] % 2 == 0
    facts = read_embedded(out)
    assert (facts["method"], facts["slow"]) == (method, 5)
    assert read_embedded(tmp_path / "s.png") == facts
    images = list(fuse(recording, method=method, fps=50))
    assert count == len(images)
    rows = [line.split(",") for line in (tmp_path / "fan.csv").read_text().splitlines()
            if line.startswith("fused,")]
    assert len(rows) == 6 * len(images)
    # Against the images themselves, with a mask written down here.
    yy, xx = np.mgrid[:64, :72]
    r = np.hypot(xx - x, yy - y)
    measured = 0
    for i, image in enumerate(images):
        turned = 2 * np.pi * rpm / 60e6 * (image.t_us - recording.info.start_us)
        place = np.angle(np.exp(1j * (np.arctan2(y - yy, xx - x) - turned)))
        for k in range(6):
            away = np.abs(np.angle(np.exp(1j * (place - k * np.pi / 3))))
            mask = ((away <= np.pi / 3 * 0.35) & (r >= 12) & (r <= 24) & image.valid)
            assert int(rows[6 * i + k][3]) == mask.sum()
            if not mask.any():  # saturated, and too short for kalman
                continue
            measured += 1
            s1, s2 = (float(p[mask].mean(dtype=float)) for p in (image.s1, image.s2))
            want = np.rad2deg(np.arctan2(s2, s1) / 2)
            got = float(rows[6 * i + k][4])
            assert abs((got - want + 90) % 180 - 90) < 0.1
    assert measured >= 20


@pytest.mark.gate
def test_fan_takes_a_second_camera(tmp_path, wheel, monkeypatch, capsys):
    recording, _ = wheel
    opens_by(monkeypatch, opener({"a": recording, "b": recording}))
    heights = []
    for extra in ([], ["--beside", "b"]):
        out = tmp_path / f"{len(extra)}.webm"
        assert fan.main(["a", "-o", str(out), "--fps", "40", *extra]) == 0
        reader = cv2.VideoCapture(str(out))
        heights.append(reader.get(cv2.CAP_PROP_FRAME_HEIGHT))
        reader.release()
    assert heights[1] > heights[0] + 60


@pytest.mark.gate
@pytest.mark.parametrize("name", ["fruits_IMX250MZR.png", "camera_IMX250MZR.png"])
def test_fan_shows_a_real_sony_mosaic_beside(
        tmp_path, wheel, monkeypatch, data_dir, name):
    real = fan.open_recording
    opens_by(
        monkeypatch, lambda path, *facts, **options: wheel[0] if str(path) == "a"
        else real(path, *facts, **options))
    still = tmp_path / "s.png"
    assert fan.main(["a", "-o", str(tmp_path / "f.webm"), "--fps", "10", "--method",
                     "cf", "--beside", str(data_dir / name), "--beside-layout", "sony",
                     "--still", str(still)]) == 0
    picture = cv2.imread(str(still))
    mosaic = cv2.imread(str(data_dir / name), cv2.IMREAD_UNCHANGED)
    # Its intensity at 0 degrees is found in the sheet, as high as the wheel's panels.
    channel, best = mosaic[1::2, 1::2], 0.0
    for scale in range(1, 13):
        height = scale * wheel[0].info.sensor_size[0]
        width = round(height * channel.shape[1] / channel.shape[0])
        if height < picture.shape[0] and width < picture.shape[1]:
            best = max(best, cv2.matchTemplate(
                np.ascontiguousarray(picture[:, :, 0]),
                cv2.resize(channel, (width, height), interpolation=cv2.INTER_AREA),
                cv2.TM_CCOEFF_NORMED).max())
    assert best > 0.7


def load_csv(path, scene, offset=0.2, skew=50e-6):
    own = np.arange(0, 1.7, 0.001)
    strain = scene.strain(1e6 * (offset + (1 + skew) * own))
    path.write_text("time (s),force (N)\n" + "\n".join(
        f"{t:.3f},{1000 * s:.6f}" for t, s in zip(own, strain, strict=True)))


def test_tendon_finds_the_load_and_writes_everything(
        tmp_path, pulled, monkeypatch, capsys):
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("matplotlib")
    recording, _, scene = pulled
    load_csv(tmp_path / "load.csv", scene)
    opens_by(monkeypatch, opener({"a": recording}))
    out = tmp_path / "out"
    assert tendon.main([
        "a", "-o", str(out), "--region", "fibre=8,6,16,12", "--fps", "30",
        "--load", str(tmp_path / "load.csv"), "--offset", "0.2",
        "--thickness-um", "300", "--wavelength-nm", "530"]) == 0
    text, err = capsys.readouterr()
    assert "lag and hysteresis cannot be told" not in err
    hz = float(re.search(r"fibre: ([\d.]+) ", text).group(1))
    zero = float(re.search(r"its zero lies at ([\d.]+) s", text).group(1))
    assert zero == pytest.approx(0.2, abs=0.002)
    assert hz == pytest.approx(5.0, rel=0.005)
    assert "extinction ratio assumed (34.5, the middle of 25 to 44)" in text
    table = pandas.read_csv(out / "traces.csv")
    images = list(fuse(recording, extinction_ratio=34.5,
                       times_us=grid_times(recording, 30, None, None)))
    mean = [[float(p[6:18, 8:24].mean(dtype=float)) for p in (f.s0, f.s1, f.s2)]
            for f in images if f.valid[6:18, 8:24].all()]
    s0, s1, s2 = np.array(mean).T
    np.testing.assert_allclose(
        table["dolp"][-len(s0):], np.hypot(s1, s2) / s0, rtol=1e-5)
    delta = np.arcsin(table["dolp"])
    np.testing.assert_allclose(table["retardance_deg"], np.rad2deg(delta), rtol=1e-5)
    np.testing.assert_allclose(
        table["birefringence"], delta * 0.530 / (2 * np.pi * 300), rtol=1e-5)
    assert table["force_n"].between(19, 31).sum() > 30
    tifffile = pytest.importorskip("tifffile")
    with tifffile.TiffFile(out / "maps.ome.tif") as file:
        assert file.asarray().shape == (8, 24, 32)
        for text in ("mean AoP (deg)", "phase of DoLP (deg)", 'SizeX="32"'):
            assert text in file.ome_metadata
    report = (out / "report.html").read_text()
    assert not re.search(r"(src|href)=\"?(http|/|\.)", report)  # holds all it shows
    assert report.count("data:image/png;base64,") == 6
    row = pandas.read_csv(out / "results.csv").iloc[0]
    for name in ("birefringence", "dolp_amplitude", "phase_deg"):
        assert f"{row[name]}" in report
    everything = json.loads((out / "results.json").read_text())
    assert everything["regions"][0]["loop_area"] == pytest.approx(
        row["loop_area"], abs=row["loop_area_se"])
    assert abs(row["lag_behind_load_deg"]) < 1
    names = {path.name for path in out.iterdir()}
    assert json.loads((out / "traces.csv.json").read_text())["hz"] == pytest.approx(
        hz, abs=1e-4)
    assert names == {"traces.csv", "traces.csv.json", "traces-jaer.csv", "frames.csv",
                     "frames.csv.json", "cycle.csv", "loop.csv", "maps.ome.tif",
                     "results.csv", "results.json",
                     "tendon.webm", "report.html"}


@pytest.mark.parametrize(("given", "zero"), [
    pytest.param([], 0.2, marks=pytest.mark.gate), (["--load-sign", "-1"], 0.1)])
def test_an_offset_that_is_not_known_gives_no_loop(
        tmp_path, pulled, monkeypatch, capsys, given, zero):
    pytest.importorskip("matplotlib")
    recording, _, scene = pulled
    load_csv(tmp_path / "load.csv", scene)
    opens_by(monkeypatch, opener({"a": recording}))
    assert tendon.main(["a", "-o", str(tmp_path), "--no-video", "--fps", "50", "--load",
                        str(tmp_path / "load.csv"), "--offset", "0.2", "--within",
                        "0.15", *given]) == 0
    said = capsys.readouterr()
    found = float(re.search(r"its zero lies at ([\d.]+) s", said.out).group(1))
    found += recording.info.start_us / 1e6
    assert found == pytest.approx(zero, abs=0.003) or (
        "-1" in given and found == pytest.approx(0.3, abs=0.003))
    assert not (tmp_path / "loop.csv").exists()
    assert "lag and hysteresis cannot be told" in said.err


@pytest.mark.gate
def test_tendon_takes_the_clock_from_triggers(tmp_path, pulled, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    recording, _, scene = pulled
    packets = list(recording.packets())
    own = np.array([0.1, 0.45, 0.8, 1.3])
    pulses = np.zeros(8, packets[0].triggers.dtype)
    pulses["t"][::2] = np.rint(1e6 * (0.2 + (1 + 50e-6) * own))
    pulses["t"][1::2] = pulses["t"][::2] + 3000
    pulses["type"] = [1, 2] * 4
    with_pulses = recording_from_arrays(
        np.concatenate([p.events for p in packets]),
        [f for p in packets for f in p.frames], triggers=pulses,
        sensor_size=recording.info.sensor_size, layout=recording.info.layout)
    t = np.arange(0, 1.7, 0.001)
    level = [5 * any(o <= now < o + 0.003 for o in own) for now in t]
    strain = scene.strain(1e6 * (0.2 + (1 + 50e-6) * t))
    (tmp_path / "load.csv").write_text("time (s),force (N),trigger (V)\n" + "\n".join(
        f"{a:.3f},{b:.6f},{c}" for a, b, c in zip(t, 1e3 * strain, level, strict=True)))
    opens_by(monkeypatch, opener({"a": with_pulses}))
    assert tendon.main(["a", "-o", str(tmp_path), "--no-video", "--fps", "50", "--load",
                        str(tmp_path / "load.csv"), "--align", "trigger"]) == 0
    text = capsys.readouterr().out
    zero = float(re.search(r"its zero lies at ([\d.]+) s", text).group(1))
    start = with_pulses.info.start_us / 1e6
    assert zero == pytest.approx(0.2 - start, abs=0.001)   # a sample of the load file


@pytest.mark.gate
def test_tendon_subtracts_the_polarization_of_the_light(
        tmp_path, pulled, monkeypatch, capsys):
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("matplotlib")
    recording, _, _ = pulled
    angles = np.deg2rad(np.tile(recording.info.layout.angles_deg, (12, 16)))
    light = 400 * (1 + 0.1 * np.cos(2 * angles))   # S1 / S0 = 0.1
    empty = recording_from_arrays(
        None, [ApsFrame(light.astype(np.float32), k * 50_000, k * 50_000 + 20_000)
               for k in range(3)],
        sensor_size=(24, 32), layout=recording.info.layout)
    opens_by(monkeypatch, opener({"a": recording, "b": empty}))
    vectors = []
    for extra in ([], ["--background", "b"]):
        assert tendon.main(["a", "-o", str(tmp_path), "--no-video", "--fps", "20",
                            "--set", "extinction_ratio=none", *extra]) == 0
        table = pandas.read_csv(tmp_path / "traces.csv")
        vectors.append(table["dolp"] * np.exp(2j * np.deg2rad(table["aop_deg"])))
    capsys.readouterr()
    np.testing.assert_allclose(vectors[0] - vectors[1], 0.1, atol=2e-4)


def true_wave(truth, hz, x, y):
    """Mean, amplitude and phase at time 0 of DoLP of a region's mean Stokes vector."""
    t = np.arange(64) / 64 / hz * 1e6
    s0, s1, s2 = np.array([np.mean(truth.stokes(now, x, y), 1) for now in t]).T
    found = np.fft.fft(np.hypot(s1, s2) / s0) / 64
    return abs(found[0]), 2 * abs(found[1]), np.angle(found[1])


@pytest.mark.gate
@pytest.mark.parametrize(("hz", "seconds", "stated"), [
    (1.01, 4.0, []), (20.26, 6.0, []),
    # Stated as one that frames see at two phases; events tell it from that.
    (10.13, 4.0, ["--load-hz", "10"])])
def test_amplitude_and_phase_of_any_speed_are_those_of_the_light(
        tmp_path, monkeypatch, capsys, hz, seconds, stated):
    pytest.importorskip("matplotlib")
    recording, truth = Camera.preset("nominal", seed=1001, size=(28, 36)).record(
        Tendon(hz=hz), seconds)
    opens_by(monkeypatch, opener({"a": recording}))
    assert tendon.main(["a", "-o", str(tmp_path), "--no-video", "--region",
                        "m=6,4,24,20", *stated]) == 0
    row = json.loads((tmp_path / "results.json").read_text())["regions"][0]
    y, x = np.mgrid[4:24, 6:30]
    mean, amplitude, phase = true_wave(truth, hz, x.ravel(), y.ravel())
    assert row["dolp"] == pytest.approx(mean, rel=0.01)
    # The extinction ratio is not known: 1.1 % (one sigma).
    assert row["dolp_amplitude"] == pytest.approx(amplitude, rel=0.02)
    phase += 2 * np.pi * hz * recording.info.start_us / 1e6
    off = np.angle(np.exp(1j * (np.deg2rad(row["phase_deg"]) - phase)))
    assert abs(np.rad2deg(off)) < 3 * row["phase_se_deg"] < 1.5


@pytest.mark.gate
def test_a_load_in_step_with_the_frames_is_refused_and_the_mean_written(
        tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    scene = Tendon(hz=10.0)
    recording, _ = Camera.preset("ideal", size=(20, 24)).record(scene, 2.0)
    opens_by(monkeypatch, opener({"a": recording}))
    load_csv(tmp_path / "load.csv", scene)
    assert tendon.main(["a", "-o", str(tmp_path), "--no-video", "--load-hz", "10",
                        "--load", str(tmp_path / "load.csv"), "--offset", "0.2"]) == 0
    assert not (tmp_path / "loop.csv").exists()
    assert "see 10 Hz always at the same phases" in capsys.readouterr().out
    row = json.loads((tmp_path / "results.json").read_text())["regions"][0]
    assert "dolp_amplitude" not in row
    assert 0.2 < row["dolp"] < 0.8


@pytest.mark.parametrize(("arguments", "message"), [
    (["--region", "340,0,20,20"], "roi '340,0,20,20' must lie inside the image"),
    (["--region", "1,1,4,4", "--demosaic", "superpixel"], "even x, y, width"),
    (["--region", "3,3,0,5"], "must not be empty"),
    (["--region", "no.zip"], "no.zip: No such file"),
    (["--region", "a=0,0,4,4", "--region", "a=8,8,4,4"], "must have different names"),
    (["--load", "gone.csv"], "gone.csv: No such file"),
    (["--load", "wrong.csv"], "the unit must be one of N, mN, kN, gf, lbf"),
    (["--load", "late.csv", "--align", "offset", "--offset", "0"],
     "no sample falls on the recording; its clock may be another"),
    (["--align", "offset", "--load", "late.csv"], "--align offset needs --offset"),
    (["--offset", "0,5"], "a decimal point is needed, got '0,5'"),
    (["--thickness-um", "300"], "belong together"),
])
def test_mistakes_give_one_line_and_2_and_no_report(
        tmp_path, pulled, monkeypatch, capsys, arguments, message):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "wrong.csv").write_text("time (s),force (furlong)\n0,1\n1,2\n")
    (tmp_path / "late.csv").write_text("time (s),force (N)\n900,1\n901,2\n902,1\n")
    opens_by(monkeypatch, opener({"a": pulled[0]}))
    assert tendon.main(["a", "-o", "out", "--fps", "50", *arguments]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines()
             if not line.startswith("pdavis: warning")]
    assert len(lines) == 1
    assert message in lines[0]
    left = tmp_path / "out"
    assert not left.exists() or list(left.iterdir()) == []


def test_an_unwritable_folder_gives_one_line(tmp_path, pulled, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    (tmp_path / "file").write_text("")
    opens_by(monkeypatch, opener({"a": pulled[0]}))
    assert tendon.main(["a", "-o", str(tmp_path / "file" / "out")]) in (1, 2)
    assert len(capsys.readouterr().err.splitlines()) == 1
    opens_by(monkeypatch, opener({"a": pulled[0]}))
    for folder in ("none", "file"):
        out = tmp_path / folder / "fan.webm"
        assert fan.main(["a", "-o", str(out)]) in (1, 2)
        said = capsys.readouterr().err.splitlines()
        assert len(said) == 1
        assert said[0].startswith(f"pdavis: {out}: ")


def test_an_interrupt_leaves_no_video(tmp_path, wheel, monkeypatch, capsys):
    def stop(frame):
        raise KeyboardInterrupt

    opens_by(monkeypatch, opener({"a": wheel[0]}))
    monkeypatch.setattr(PolarFrame, "dolp", property(stop))
    assert fan.main(["a", "-o", str(tmp_path / "fan.webm"), "--fps", "40"]) == 130
    assert list(tmp_path.iterdir()) == []
    assert "interrupted" in capsys.readouterr().err


@pytest.mark.gate
@pytest.mark.parametrize("command", [
    ["export", "-o", "x.mp4"], ["export", "-o", "x.avi"], ["export", "-o", "x.png"],
    ["export", "-o", "x.npy"], ["export", "-o", "x.npz"], ["export", "-o", "x.h5"],
    ["fan", "-o", "x.mkv"], ["tendon", "-o", ".", "--no-video"]])
def test_a_full_disk_gives_one_line_that_names_the_file(
        tmp_path, monkeypatch, capfd, command):
    monkeypatch.chdir(tmp_path)
    resource = pytest.importorskip("resource")
    pytest.importorskip("matplotlib")
    tool, *options = command
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    previous = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4_000, hard))
    try:
        code = {"export": export, "fan": fan, "tendon": tendon}[tool].main(
            [str(example_recording()), *options, "--fps", "100", "--layout", "pdavis"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, previous)
    lines = [line for line in capfd.readouterr().err.splitlines()
             if not line.startswith("pdavis: warning")]
    assert code == 1
    assert len(lines) == 1
    assert re.match(r"pdavis: (x|maps)[-\w]*(\.\w+)+: ", lines[0])
    assert not list(tmp_path.iterdir())


def glare(columns):
    """A recording in which the first columns saturate every frame; 300 DN beside."""
    shape = (20, 40)
    dn = np.full(shape, 300.0, np.float32)
    dn[:, :columns] = 760
    valid = dn < 700
    frames = [ApsFrame(dn, t, t + 10_000, valid=valid, available_us=t + 12_000)
              for t in range(0, 400_000, 50_000)]
    events = np.zeros(30, EVENT_DTYPE)  # one pixel flickers
    events["t"], events["x"] = np.arange(30) * 13_000 + 5_000, 39
    events["p"] = np.arange(30) % 2
    return recording_from_arrays(
        events, frames, sensor_size=shape, layout=Layout.PDAVIS)


@pytest.mark.gate
@pytest.mark.parametrize("method", ["frames", "cf", "kalman"])
@pytest.mark.parametrize("columns", [20, 40])
def test_what_saturates_every_frame_is_white(tmp_path, monkeypatch, method, columns):
    recordings = opener({"a": glare(columns)})
    opens_by(monkeypatch, recordings)
    out = tmp_path / "a.png"
    for quantity in ("s0", "i45"):
        assert export.main(["a", "-o", str(out), "--at", "0.3", "--method", method,
                            "--bare", "--quantities", quantity]) == 0
        picture = cv2.imread(str(out))
        assert picture.shape == (20, 40, 3)
        assert (picture[:, :columns] == 255).all()
        assert (picture[:, columns + 1:] < 255).all()
    assert fan.main(["a", "-o", str(tmp_path / "a.webm"), "--fps", "20", "--method",
                     method, "--still", str(out)]) == 0
    white = (cv2.imread(str(out)) == 255).all(-1)
    runs = np.lib.stride_tricks.sliding_window_view(white, (20, columns)).all((2, 3))
    assert np.count_nonzero(runs) >= 2  # I0 of the frames and of the method


@pytest.mark.parametrize("name", ["a.ome.tif", "a.h5", "a.npz"])
def test_export_writes_stacks(tmp_path, name, capsys):
    sample = str(example_recording())
    assert export.main([sample, "-o", str(tmp_path / name), "--fps", "50", "--layout",
                        "pdavis", "--pixel-um", "0.5", "--quantities", "i45,dolp",
                        "--method", "cf"]) == 0
    assert "float32, 9 x 2 x 260 x 346 (i45, dolp)" in capsys.readouterr().out
    with open_recording(sample, layout=Layout.PDAVIS) as recording:
        want = [np.where(f.valid, f.quad[1], np.nan)
                for f in fuse(recording, fps=50, method="cf")]
    if name.endswith("tif"):
        got = pytest.importorskip("tifffile").imread(tmp_path / name)[:, 0]
    elif name.endswith("h5"):
        with pytest.importorskip("h5py").File(tmp_path / name) as file:
            got = file["i45"][:]
    else:
        with np.load(tmp_path / name) as file:
            got = file["i45"]
    np.testing.assert_array_equal(got, want)


def test_export_refuses_to_resume_a_video(tmp_path, capsys):
    assert export.main([str(example_recording()), "-o", str(tmp_path / "a.webm"),
                        "--resume"]) == 2
    assert "--resume continues .tif, .h5, .npz" in capsys.readouterr().err


def test_the_scenes_of_these_tests_give_no_warning(pulled):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert next(fuse(pulled[0], fps=10)).valid.any()
