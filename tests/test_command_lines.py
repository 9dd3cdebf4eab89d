"""A thousand command lines that no one would write: an answer, one line, never more."""
import contextlib
import io
import os
import re
import signal

import numpy as np
import pytest

import pdavis_cv
from pdavis_cv.data import example_recording
from pdavis_cv.tools.main import COMMANDS, main

LINES = 1000
SEED = int(os.environ.get("PDAVIS_TEST_SEED", "25"))
"""Other seeds draw other command lines."""
SHOWN = re.compile(r"pdavis: .*( \.\.\.|: \d+ s)|.*\[\d\d:\d\d.*|\s*")
"""What --progress writes to stderr: stages, their duration, and tqdm's bars."""
LONGEST_S = 60
VALUES = ("0", "-1", "1", "inf", "-inf", "nan", "1e300", "-1e300", "5e-324", "9" * 40,
          "", "0x10", "1,2", "0,0,0,0", "-1,-1,9,9", "inf,0,2,2", "a=b", "=", "a",
          "pdavis", "sony", "90,45,135,0", "none", "nominal", "../..", "/", "/dev/null",
          "\0", "%s", "\u202e", "x" * 5000, "--help", "-", "--")
SUBCOMMANDS = {
    "calibrate": ("dark", "flat", "clip", "layout", "sweep", "thresholds", "background",
                  "all", "check", "align", "?"),
    "weights": ("convert", "show", "?"),
}
# What runs for long where nothing is wrong with the line is given something wrong.
CERTAIN = {"demo": ("--bogus",), "simulate": ("--seconds", "0"),
           "stream": ("--bogus",), "view": ("--bogus",),
           "webcam": ("--bogus",)}


class Hang(Exception):
    pass


def said(arguments):
    """Return the exit code and what a command wrote to stdout and stderr."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        return main(arguments), out.getvalue(), err.getvalue()


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Return names of files that are wrong in some way, in a folder of their own."""
    monkeypatch.chdir(tmp_path)
    good = example_recording().read_bytes()[:60_000]
    contents = {"empty": b"", "junk.aedat4": b"\x00\xff" * 500, "cut.aedat4": good,
                "text.csv": b"1 2 3\nx\n", "magic.h5": b"\x89HDF\r\n\x1a\n" + bytes(99),
                "x.npz": b"PK\x03\x04" + bytes(60), "x.npy": b"\x93NUMPY\x01\x00v\x00"}
    for name, data in contents.items():
        (tmp_path / name).write_bytes(data)
    (tmp_path / "folder").mkdir()
    with pdavis_cv.Aedat4Writer(tmp_path / "none-in-it.aedat4", sensor_size=(4, 6)):
        pass
    return [*contents, "folder", "missing", "none-in-it.aedat4", "simulate:?",
            "dv+tcp:", "replay:", "", "."]


def problems_in(err, line):
    """Return the lines of stderr that are neither warnings nor progress asked for."""
    shown = SHOWN if "--progress" in line else re.compile("")
    return [text for text in err.splitlines()
            if not text.startswith("pdavis: warning: ") and not shown.fullmatch(text)]


def options_of(command):
    """Return the options that a command's help names."""
    _, text, _ = said([*command.split(), "--help"])
    found = set(re.findall(r"(?<![\w-])--?[a-z][a-z-]*", text))
    return sorted(found - {"-h", "--help"})


@pytest.mark.gate
def test_a_thousand_wrong_command_lines_are_one_line_each(files):
    rng = np.random.default_rng(SEED)

    def some(of, count=1):
        return [str(of[int(k)]) for k in rng.integers(0, len(of), count)]

    def stop(*_):
        raise Hang

    known = {}
    before = signal.signal(signal.SIGALRM, stop)
    codes, complaints = [], []
    try:
        for _ in range(LINES):
            command = some(list(COMMANDS))[0]
            line = [command, *some(SUBCOMMANDS.get(command, ("",)))]
            line = [part for part in line if part]
            name = " ".join(line)
            if name not in known:
                known[name] = options_of(name) or ["--bogus"]
            for _ in range(int(rng.integers(0, 5))):
                option, value = some(known[name])[0], some(VALUES)[0]
                line += [f"{option}={value}"] if rng.integers(2) else [option, value]
            line += some(files, int(rng.integers(0, 3)))
            line += CERTAIN.get(command, ())
            signal.alarm(LONGEST_S)
            code, _, err = said(line)
            signal.alarm(0)
            problems = problems_in(err, line)
            one = len(problems) == (code != 0) or code == 1
            if code not in (0, 1, 2) or "mistake of pdavis" in err or not one:
                complaints.append((code, line, err))
            codes.append(code)
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    assert not complaints
    assert codes.count(2) > LINES // 2


def test_progress_is_told_from_problems():
    shown = ("pdavis: reading x ...\npdavis: reading x: 4 s\n\r  0%|  | 0/9 "
             "[00:00<?, ? images/s]\r                       \r")
    assert problems_in(shown, ["export", "--progress"]) == []
    assert len(problems_in(shown, ["export"])) > 2
    wrong = "pdavis: x: not a recording\nTraceback (most recent call last):"
    assert problems_in(wrong, ["export", "--progress"]) == wrong.splitlines()
