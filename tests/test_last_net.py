"""Command lines that are wrong in every way: one line and a code, no traceback."""
import os
import subprocess
import sys

import numpy as np
import pytest

import pdavis_cv
from pdavis_cv.data import example_recording
from pdavis_cv.errors import RecordingError
from pdavis_cv.simulation import Camera, RotatingPolarizer
from pdavis_cv.tools import _common
from pdavis_cv.tools._common import command
from pdavis_cv.tools.main import main

FILE = str(example_recording())
EXPORT = ("export", FILE, "-o", "x.npy", "--layout", "pdavis")
SIMULATE = ("simulate", "polarizer", "-o", "x.aedat4")
FAN = ("fan", FILE, "-o", "x.mp4", "--layout", "pdavis", "--centre", "172,129")
NUMBERS = ("inf", "-inf", "nan", "1e300", "-1e300", "1e18", "0x10", "", "1,2", "one",
           "9" * 40)


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def one_line(capsys, code=2):
    err = capsys.readouterr().err
    assert err.startswith("pdavis: ")
    assert err.count("\n") == 1
    assert "mistake of pdavis" not in err or code == 70
    return err


@pytest.mark.parametrize("arguments", [
    ("--bogus",), ("bogus",), ("export",), ("export", FILE), ("info", "--scan"),
    (*EXPORT, "--bogus"), (*EXPORT, "--roi", "inf,0,2,2"), (*EXPORT, "--roi", "1,2"),
    (*EXPORT, "--per-row", "0"), (*EXPORT, "--per-row", "1000000"),
    (*EXPORT, "--at", "1e12"), (*SIMULATE, "--seconds", "1e12"),
    (*SIMULATE, "--rpm", "1e12"), (*SIMULATE, "--seed", "-1"),
    (*SIMULATE, "--threads", "0"), (*FAN, "--radius", "9", "--scale", "100000"),
    (*FAN, "--radius", "9", "--sectors", "0"),
    ("export", FILE, "-o", "x.mp4", "--slow=1e17", "--method", "frames",
     "--layout", "pdavis")])
def test_a_wrong_command_line_is_one_line(arguments, capsys, tmp_path):
    assert main(arguments) == 2
    one_line(capsys)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("option", ["--start", "--stop", "--at", "--fps", "--slow",
                                    "--white", "--extinction-ratio", "--roi"])
@pytest.mark.parametrize("number", NUMBERS)
def test_numbers_are_checked_where_they_are_parsed(option, number, capsys, tmp_path):
    assert main([*EXPORT, f"{option}={number}"]) == 2
    one_line(capsys)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("option", ["--rpm", "--seconds", "--hz", "--start-deg",
                                    "--light", "--background", "--flicker", "--seed"])
@pytest.mark.parametrize("number", ["inf", "nan", "1e300", "-1e19", "9" * 40])
def test_numbers_of_scenes_too(option, number, capsys, tmp_path):
    assert main([*SIMULATE, f"{option}={number}"]) == 2
    one_line(capsys)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("error", [
    OverflowError("int too large"), ZeroDivisionError("division by zero"),
    KeyError("x"), RecursionError(), AssertionError(), RuntimeError("two\nlines"),
    np.linalg.LinAlgError("singular")])
def test_what_nobody_thought_of_is_one_line_that_says_how_to_report_it(
        error, capsys, monkeypatch):
    @command
    def broken(argv=None):
        raise error

    monkeypatch.delenv(_common.TRACEBACK, raising=False)
    if isinstance(error, ValueError):       # LinAlgError is one: the values are wrong
        assert broken() == 2
        return
    assert broken() == 70
    err = one_line(capsys, 70)
    assert type(error).__name__ in err
    assert "please report" in err
    monkeypatch.setenv(_common.TRACEBACK, "1")
    with pytest.raises(type(error)):
        broken()


def test_lack_of_memory_is_no_mistake_of_ours(capsys):
    @command
    def large(argv=None):
        np.empty(1 << 60, np.uint8)

    assert large() == 1
    assert "not enough memory: Unable to allocate" in one_line(capsys)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize("stdout", ["/dev/full", "closed"])
def test_an_output_that_cannot_be_written_is_one_line(stdout):
    code = "from pdavis_cv.tools.main import main; raise SystemExit(main(['info', %r]))"
    line = f"{sys.executable} -P -c \"{code % FILE}\" " + (
        ">&-" if stdout == "closed" else f"> {stdout}")
    run = subprocess.run(["sh", "-c", line], capture_output=True, text=True,
                         check=False)
    if stdout == "closed":      # nobody wants to know
        assert (run.returncode, run.stderr) == (0, "")
    else:
        assert run.returncode == 1
        assert run.stderr == "pdavis: [Errno 28] No space left on device\n"


def test_simulations_say_what_memory_they_would_take():
    camera = Camera.preset("nominal", size=(12, 12))
    with pytest.raises(ValueError, match=r"step_us must leave .* within 4 GiB, got"):
        camera.stream(RotatingPolarizer(rpm=1), 1.0, step_us=1e-6)
    with pytest.raises(ValueError, match=r"seconds must leave the frames; stream\(\)"):
        camera.record(RotatingPolarizer(rpm=1), 1e9)
    with pytest.raises(ValueError, match=r"seconds must be less than 2\*\*61 us"):
        camera.stream(RotatingPolarizer(rpm=1), 1e13)


def test_a_folder_that_is_read_only_is_named(tmp_path, capsys):
    if os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    tmp_path.chmod(0o500)
    assert main(list(EXPORT)) == 2
    assert "x.npy" in one_line(capsys)


def test_errors_of_the_library_stay_what_they_are():
    with pytest.raises(RecordingError):
        pdavis_cv.open_recording("missing.aedat4")


@pytest.mark.parametrize("arguments", [
    ("export", FILE), ("score", FILE), ("simulate", "fan")])
def test_two_dashes_are_no_name_of_a_file(arguments, capsys):
    assert main([*arguments, "-o=--"]) == 2
    assert "-o/--out: expected one argument, got '--'" in one_line(capsys)


@pytest.mark.parametrize("arguments", [
    ("export", FILE), ("fan", FILE), ("simulate", "polarizer"), ("convert", FILE),
    ("score", FILE), ("calibrate", "thresholds", FILE)],
    ids=lambda arguments: arguments[0])
def test_a_folder_that_is_not_there_is_named_before_the_work(
        arguments, tmp_path, capsys, monkeypatch):
    def work(*args, **options):
        raise AssertionError("the work has begun")

    monkeypatch.setattr("pdavis_cv.fusion.engine.Fusion.__init__", work)
    monkeypatch.setattr("pdavis_cv.simulation.Camera.record", work)
    out = tmp_path / "missing" / ("x.webm" if arguments[0] == "fan" else "x.aedat4")
    if arguments[0] == "export":
        out = out.with_suffix(".npy")
    given = (str(out),) if arguments[0] == "convert" else ("-o", str(out))
    assert main([*arguments, *given]) == 2
    assert f"{out}: there is no folder {out.parent} to write to" in one_line(capsys)
