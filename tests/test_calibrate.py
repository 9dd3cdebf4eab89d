"""pdavis calibrate: from simulated recordings of known chips to a calibration file."""
import json

import numpy as np
import pytest
from ideal import rotating_polarizer
from streams import opens_by

from pdavis_cv import Calibration, Layout
from pdavis_cv.simulation import FlatLight, MalusSweep, RotatingPolarizer
from pdavis_cv.simulation.camera import Camera
from pdavis_cv.tools.main import main

pytestmark = pytest.mark.accuracy

HOLD_S = 0.5


@pytest.fixture(scope="module")
def bench():
    """What a bench records of one chip, by file name."""
    chip = Camera.preset("nominal", seed=5, size=(12, 12))
    frames_only = Camera.preset("nominal", seed=5, size=(12, 12), dvs=None)
    return chip, {
        "dark": frames_only.record(FlatLight(s0=0.0), 2.0, run=1)[0],
        "flat": frames_only.record(FlatLight(), 2.0, run=2)[0],
        "sweep": frames_only.record(
            MalusSweep(hold_us=HOLD_S * 1e6, move_us=40_000), 37 * HOLD_S, run=3)[0],
        "slow": chip.record(RotatingPolarizer(rpm=30.39), 3.0, run=4)[0],
        "other": rotating_polarizer(41.0, 1.0, size=(14, 12))[0]}


@pytest.fixture
def files(bench, monkeypatch):
    """Let the tool open those recordings by name."""
    def opener(name, *options):
        if name not in bench[1]:
            raise FileNotFoundError(2, "No such file or directory", name)
        return bench[1][name]
    opens_by(monkeypatch, opener)
    return bench[0]


@pytest.mark.gate
def test_all_parts_go_into_one_file_with_a_report_each(files, tmp_path, capsys):
    out = tmp_path / "camera.npz"
    assert main([
        "calibrate", "all", "--dark", "dark", "--sweep", "sweep", "--hold-s",
        str(HOLD_S), "--thresholds", "slow", "--nominal", "0.16,0.18",
        "--wavelength-nm", "500", "-o", str(out)]) == 0
    found, chip = Calibration.load(out), files
    assert {"dark", "analyser", "usable", "theta_on", "theta_off", "layout"} <= set(
        found.parts)
    assert found.serial == chip.serial
    assert found.notes["wavelength_nm"] == 500
    assert found.notes["sweep"]["files"] == ["sweep"]
    for place in range(4):
        part = np.s_[place // 2::2, place % 2::2]
        assert np.median(found.extinction_ratio[part]) == pytest.approx(
            np.median(chip.maps["extinction_ratio"][part]), rel=0.03)  # 10 frames each
    ratio = np.log(found.theta_on / found.theta_off)
    true = np.log(chip.maps["theta_on"] / chip.maps["theta_off"])
    assert np.std(ratio - true) < 0.03      # nominal values would leave 0.047
    printed = capsys.readouterr().out
    assert "0 deg at 500 nm: extinction ratio" in printed
    assert "refractory period: none that matters" in printed
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        return
    for part in ("dark", "sweep", "thresholds"):
        assert (tmp_path / f"camera.{part}.png").read_bytes()[:4] == b"\x89PNG"
    assert not list(tmp_path.glob("*.part"))


def test_layout_is_written_only_when_it_is_known(files, tmp_path, capsys):
    out = tmp_path / "camera.npz"
    assert main(["calibrate", "layout", "slow", "-o", str(out)]) == 0
    assert Calibration.load(out).layout is None
    assert "candidates" in capsys.readouterr().out
    assert main(["calibrate", "layout", "slow", "-o", str(out), "--direction", "ccw",
                 "--known", f"1,{30.39 / 60 * 360}"]) == 0
    assert Calibration.load(out).layout == Layout.PDAVIS


def test_the_flat_frame_and_one_file_per_angle(files, tmp_path):
    out = tmp_path / "camera.npz"
    assert main(["calibrate", "flat", "flat", "-o", str(out)]) == 0
    assert Calibration.load(out).parts == ("gain", "usable")


@pytest.mark.parametrize(("arguments", "code", "words"), [
    (["dark", "missing", "-o", "OUT"], 2, "missing: No such file"),
    (["dark", "dark"], 2, "-o/--out"),
    (["all", "-o", "OUT"], 2, "at least one part"),
    (["sweep", "sweep", "--angles", "0,5", "-o", "OUT"], 2, "names 2 angles for 1"),
    (["flat", "dark", "-o", "OUT"], 2, "needs light"),
    (["layout", "dark", "-o", "OUT"], 2, "must see a rotating polarizer"),
    (["polish", "dark"], 2, "invalid choice"),
])
def test_mistakes_give_one_line_and_no_file(
        files, tmp_path, capsys, arguments, code, words):
    out = tmp_path / "camera.npz"
    arguments = [str(out) if word == "OUT" else word for word in arguments]
    assert main(["calibrate", *arguments]) == code
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1
    assert not out.exists()


def test_another_camera_is_refused_by_name(files, tmp_path, capsys):
    out = tmp_path / "camera.npz"
    assert main(
        ["calibrate", "dark", "dark", "-o", str(out), "--json", "--progress"]) == 0
    printed = capsys.readouterr()
    assert "pdavis: measuring dark" in printed.err
    told = json.loads(printed.out)
    assert (told["wrote"], told["measured"]["dark"]["files"]) == ([str(out)], ["dark"])
    before = out.read_bytes()
    assert main(["calibrate", "dark", "other", "-o", str(out)]) == 2
    assert "calibration is of a (12, 12) sensor" in capsys.readouterr().err
    assert out.read_bytes() == before


def test_check_prints_what_it_sees(files, capsys):
    assert main(["calibrate", "check", "slow"]) == 0
    assert "orthogonal polarizers are diagonal" in capsys.readouterr().out
    assert main(["calibrate", "check", "slow", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["findings"][0]["what"] == "orientation"
