"""Text of others: what of it reaches a terminal, a page or a table."""
import csv
import io
import json
import struct
import sys

import numpy as np
import pytest
from batch_works import Inline

import pdavis_cv
from pdavis_cv import (
    DamagedFileWarning,
    FusionOptions,
    RecordingError,
    batch,
    export,
    open_source,
    serve,
)
from pdavis_cv._text import (
    MOST_TEXT,
    Shown,
    drawn,
    for_script,
    page_text,
    shown,
    table_text,
)
from pdavis_cv.data import example_recording
from pdavis_cv.render.legends import caption
from pdavis_cv.tools import main
from pdavis_cv.tools._calibration_report import Page, write_report

HOSTILE = "\x1b]0;title\x07\x1b[31mRED\x1b[2J\x9b5m\x7f\u202e"
CONTROLS = set(map(chr, [*range(9), *range(11, 32), *range(127, 160), 0x202E]))


@pytest.fixture
def file(tmp_path):
    """Return a recording whose source is a title and colours of a terminal."""
    path = tmp_path / "a.aedat"
    head = ("#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: \x1b]0;title\x07\x1b[31mRED"
            "\x1b[2J\x9b5m\r\n#!END-HEADER\r\n").encode("latin-1")
    data = b"".join(struct.pack("<Ii", 3 | k % 260 << 2 | k % 346 << 17, 10 * k)
                    for k in range(100))
    path.write_bytes(head + struct.pack("<hhiiiiii", 1, 1, 8, 4, 0, 100, 100, 100)
                     + data)
    return path


def test_controls_become_visible():
    assert shown(HOSTILE) == (
        r"\x1b]0;title\x07\x1b[31mRED\x1b[2J\x9b5m\x7f\u202e")
    assert shown("a\tµ\n") == "a\tµ\n"
    assert shown("x" * 3000, 10) == "xxxxxxxxxx ... (3000 characters)"
    stream = io.StringIO()
    print(HOSTILE, "12 %\r", file=Shown(stream))
    assert not CONTROLS & set(stream.getvalue()) - {"\r"}


@pytest.mark.parametrize("more", [(), ("--scan",), ("--json",)])
def test_info_writes_no_control_of_a_file(file, more, capsys):
    assert main.main(["info", str(file), *more]) == 0
    out, err = capsys.readouterr()
    assert not CONTROLS & set(out + err)
    assert "title" in out
    assert "RED" in out


def test_a_name_of_a_file_writes_no_control(tmp_path, capsys):
    assert main.main(["info", str(tmp_path / f"{HOSTILE}.aedat4")]) == 2
    assert not CONTROLS & set(capsys.readouterr().err)


def test_errors_and_warnings_are_plain_and_short(tmp_path, capsys):
    for kind in (RecordingError, DamagedFileWarning):
        text = str(kind(HOSTILE + "x" * 10_000))
        assert not CONTROLS & set(text)
        assert len(text) < MOST_TEXT + 100
    assert main.main(["info", "x" * 100_000]) == 2
    assert len(capsys.readouterr().err) < MOST_TEXT + 100


@pytest.mark.parametrize("start", ["=", "+", "-", "@", "\t", "\n", "\uff1d", "\uff0b"])
def test_cells_are_no_formulas(start, tmp_path):
    export.write_csv(tmp_path / "a.csv", (start + "name", "t"), [
        (start + "1+cmd|' /C calc'!A0", -1.5), ("-2.5", 3)])
    with open(tmp_path / "a.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    assert rows == [["'" + start + "name", "t"],
                    ["'" + start + "1+cmd|' /C calc'!A0", "-1.5"], ["-2.5", "3"]]
    assert table_text("plain") == "plain"
    assert table_text("\ra\x1b") == r"\ra\x1b"


def test_a_name_cannot_end_the_script_of_a_page():
    name = '</script><script>alert(1)</script><!--"\u2028'
    text = for_script([name])
    assert "<" not in text
    assert json.loads(text) == [name]


def test_a_page_has_no_control_of_a_name(tmp_path):
    assert page_text(f"<{HOSTILE}&") == f"&lt;{shown(HOSTILE)}&amp;"
    table = batch.run([tmp_path / f"{HOSTILE}.aedat4"], FusionOptions(),
                      tmp_path / "out", executor=Inline())
    assert len(table.failed) == 1
    page = (tmp_path / "out" / "index.html").read_text("utf-8")
    assert not CONTROLS & set(page)
    assert "RED" in page


@pytest.mark.parametrize("port", [-1, 65536, 99999])
def test_ports_are_checked(port):
    with pytest.raises(ValueError, match="port must be a whole number"):
        serve(example_recording(), port=port)
    with pytest.raises(pdavis_cv.DeviceError, match="port must be a whole number"):
        open_source(f"dv+tcp://127.0.0.1:80?frames={port}")


def test_a_command_without_standard_error_says_nothing(monkeypatch, capsys):
    monkeypatch.setattr(sys, "stderr", None)
    assert main.main(["info", "/no/such/file"]) == 2
    assert capsys.readouterr().out == ""


def test_a_time_that_is_no_date_is_said(tmp_path, capsys):
    events = pdavis_cv.as_events({"t": np.array([0, 5]) + 2**60, "x": [3, 3],
                                  "y": [4, 4], "p": [1, 1]})
    path = tmp_path / "a.aedat4"
    pdavis_cv.write_aedat4(path, pdavis_cv.recording_from_arrays(
        events, sensor_size=(260, 346)))
    assert main.main(["info", str(path)]) == 0
    assert "s after 1970, no date" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["$x_{", "a$b$", r"\$\alpha$", "_hidden", "\x1b["])
def test_a_name_is_no_formula_in_a_figure(name, tmp_path):
    figure = pytest.importorskip("matplotlib.figure").Figure()
    axes = figure.subplots()
    axes.plot([0, 1], label=drawn(name))
    shown, = axes.legend().get_texts()
    figure.savefig(tmp_path / "a.svg", metadata={"Date": None})
    plain = shown.get_text()
    assert shown._preprocess_math(plain)[1] is False
    assert shown._preprocess_math(plain)[0].strip() == name.replace("\x1b", r"\x1b")
    assert write_report(tmp_path / "a.png", Page(name, [name]))


def test_text_that_is_no_utf8_is_drawn_and_does_not_crash():
    picture = np.zeros((40, 200, 3), np.uint8)
    other = picture.copy()
    width = caption(picture, "a\udcff", 4, 20, 255)
    assert width == caption(other, r"a\udcff", 4, 20, 255)
    np.testing.assert_array_equal(picture, other)
    assert picture.any()
