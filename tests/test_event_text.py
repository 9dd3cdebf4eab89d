"""Lists of events as text, in the forms of many programs."""
import pickle
import zipfile

import numpy as np
import pytest
import reference_files as reference
from event_bytes import text_file
from test_event_files import SIZE, read, some_events

import pdavis_cv
from pdavis_cv import EVENT_DTYPE, RecordingError, _kernels, open_recording
from pdavis_cv.tools.main import main

LINES = ["1 2 3 1", "-5,6;7\t0", "  8 9 10 1  ", "", "# words", "1 2 3", "1 2 3 4 5",
         "1.5 2 3 1", "2.000000001 3 4 0", ".5 1 1 1", "5. 1 1 1", "1 2.5 3 1",
         "12345678901234567890 1 1 1", "9123456789012345678 1 1 1",
         "8123456789012345678 1 1 1", "1 2 3 x", "t x y p", "1 2.0 3.00 1\r",
         "-1.25 1 1 1", "1e5 1 1 1", "1.1234567899 1 1 1", "- 1 1 1", "% 1 2 3 4",
         "1.6e+06 6.0e0 3.30e1 0.0e0", "6.48359999999999e-05 1 2 1", "1e-30 1 1 1",
         "1.700000000000000123e+06 1 1 1", "1e 1 1 1", "1e99 1 1 1", "2e-9 1 1 1",
         "12345678901234567890e-10 1 1 1", "0e0 1 1 1", "-2.5E-1 1 1 1", "1e5.2 1 1 1",
         "1 2 3 True", "1 2 3 false", "1 2 3 Trip", '"1","2","3","1"', "1 2e-1 3 1",
         "1 2 3 1 noise", "1 2 3 1 0.5 7"]


def lines_read(data, order, unit, size, room=60, more=False):
    """Return the events, the bad lines, and what the kernel left of the data."""
    state, out = np.zeros(7, np.int64), np.zeros(room, EVENT_DTYPE)
    done, bad = _kernels.text_events(
        np.frombuffer(data, np.uint8), 0,
        np.array(["txyp".find(name) for name in order]), more,
        ("us", "s", "ns", "ms").index(unit), *size, state, out)
    # Times that no clock has are limited, so that they fit 64 bits.
    found = [row for row in out[:state[0]].tolist() if abs(row[0]) <= 2**61]
    return found, bad, data[done:]


@pytest.mark.parametrize("unit", ["us", "s", "ns", "ms"])
@pytest.mark.parametrize("order", ["txyp", "xypt", "pyxt", "txy_p"])
@pytest.mark.parametrize("more", [False, True])
@pytest.mark.parametrize("size", [(8192, 8192), (5, 6)])
def test_lines_of_text_equal_their_twin(unit, order, more, size):
    data = "\n".join([*LINES, "cut 1 2"]).encode()
    got, bad, left = lines_read(data, order, unit, size, more=more)
    assert (got, bad) == reference.text_events(LINES, order, unit, *size, more)
    assert left == b"cut 1 2"


def test_numbers_of_every_length_equal_their_twin():
    rng = np.random.default_rng(0)
    lines, t = [], 0
    for digits in range(1, 21):
        for fraction in ("", ".", *("." + "9" * k for k in range(1, 12))):
            t = "7" * digits + fraction
            lines += [f"{t},{rng.integers(10**4)},{rng.integers(300)},1", f"{t} 1 1 0"]
    for begin in (0, 1, 3):     # words of 8 bytes begin anywhere in memory
        data = b" " * begin + "\n".join(lines).encode() + b"\n"
        for unit in ("us", "s", "ns"):
            got, bad, _ = lines_read(data, "txyp", unit, (300, 5000), len(lines))
            assert (got, bad) == reference.text_events(
                lines, "txyp", unit, 300, 5000)


def test_the_kernel_refuses_arrays_of_the_wrong_shape():
    out, state = np.empty(50, EVENT_DTYPE), np.zeros(7, np.int64)
    for change in ({"order": [0, 1, 2]}, {"order": [0, 1, 2, 4]}, {"begin": 4},
                   {"order": [0, 1, 2, 2]}, {"order": [0, 1, 2, 3, -2]},
                   {"order": [0, 1, 2, 3] + 13 * [-1]}, {"unit": 4}, {"unit": -1},
                   {"state": state[:3]}, {"state": state - 1}, {"state": state + 51}):
        given = {"data": np.zeros(3, np.uint8), "begin": 0, "order": [0, 1, 2, 3],
                 "more": False, "unit": 0, "height": 4, "width": 4, "state": state,
                 "out": out} | change
        with pytest.raises(ValueError, match="text_events"):
            _kernels.text_events(
                *(np.array(value) if name == "order" else value
                  for name, value in given.items()))


@pytest.mark.parametrize(("line", "names", "columns"), [
    ("{x},{y},{p},{t}\n", "x,y,polarity,timestamp\n", None),
    ("{x} {y} {t} {p}\n", "", "xytp"),
    ("{p};{t};{x};{y}\n", "# p;t;x;y\n", None),
    ("{t}000 {x} {y} {p}\n", "", None)])
def test_text_says_its_columns_or_is_told(tmp_path, line, names, columns):
    events = some_events(200)
    if "000" in line:
        events["t"] += 10**15
    (tmp_path / "x.csv").write_bytes(names.encode() + text_file(events, line=line))
    found, _ = read(tmp_path / "x.csv", columns=columns)
    np.testing.assert_array_equal(found, events)


SECONDS = "{s} {x} {y} {p}\n"
FORMS = {
    "e2vid": ("640 480\n", SECONDS, {"size": SIZE}),
    "e2vid commas": ("640,480\n", "{s},{x},{y},{p}\n", {"size": SIZE}),
    "faery": ("t,x@640,y@480,on\r\n", "{t},{x},{y},{p}\r\n", {"size": SIZE}),
    "v2e": ("#!events.txt\n# Format is time (float s), x, y, polarity (0=off, 1=on), "
            "signal/noise (1/0)\n# User name: root\n", "{s} {x} {y} {p} 1\n",
            {"further columns": 1}),
    "further column": ("", "{t} {x} {y} {p} 0.25\n", {"further columns": 1}),
    "named first": ("id,ts,x,y,p,label\n", "7,{t},{x},{y},{p},noise\n", {}),
    "pandas": (",t,x,y,p\n", "7,{t},{x},{y},{p}\n", {}),
    "unit in brackets": ("timestamp [us],x,y,polarity\n", "{t},{x},{y},{p}\n", {}),
    "unit in the name": ("x;y;p;t_ns\n", "{x};{y};{p};{t}000\n", {}),
    "milliseconds": ("time_ms x y p\n", "{ms} {x} {y} {p}\n", {}),
    "quoted": ('"t","x","y","p"\n', '"{t}","{x}","{y}","{p}"\n', {}),
    "True": ("timestamp,x,y,polarity\n", "{t},{x},{y},{p:bool}\n", {}),
    "savetxt": ("", "{t:.18e} {x:.18e} {y:.18e} {p:.18e}\n", {}),
    "microseconds with fractions": ("", "{t}.25 {x} {y} {p}\n", {}),
    "microseconds with a point": ("", "{t}.000000 {x} {y} {p}\n", {}),
    "signed": ("% comment\n", "{t}\t{x}\t{y}\t{sign}\n", {}),
    "byte order": ("\ufefft,x,y,p\n", "{t},{x},{y},{p}\n", {}),
    "jAER": ("# jAER DAVIS/DVS camera text file output\n# dvs-events: One event per "
             "line: x,y,polarity(off/on=0/1),timestamp(int32,us)\n# format: x,y,p,t\n",
             "{x},{bottom},{p},{t}\n", {"sensor_size": SIZE}),
    "jAER, older": ("# dvs-events: One event per line:  timestamp(float s) x y "
                    "polarity(off/on=-1/+1)\n", "{s} {x} {bottom} {sign}\n",
                    {"sensor_size": SIZE})}


class Boolean(int):
    def __format__(self, how):
        return str(bool(self)) if how == "bool" else super().__format__(how)


@pytest.mark.parametrize("form", FORMS)
def test_text_of_many_programs_is_read(tmp_path, form):
    events = some_events(4000)
    events["y"][0] = 479
    head, line, expected = FORMS[form]
    text = head + "".join(line.format(
        t=t, s=f"{t / 1e6:.6f}", ms=f"{t / 1e3:.3f}", x=x, y=y, bottom=479 - y,
        p=Boolean(p), sign=2 * p - 1) for t, x, y, p in events.tolist())
    (tmp_path / "x.txt").write_text(text, "utf-8", newline="")
    with open_recording(tmp_path / "x.txt", **{
            key: value for key, value in expected.items() if key == "sensor_size"}
            ) as recording:
        np.testing.assert_array_equal(recording.events(), events)
        assert recording.info.sensor_size == SIZE
        counts = {p.kind: p.count for p in recording.problems}
    assert ("unknown size" in counts) == (not {"size", "sensor_size"} & expected.keys())
    counts.pop("unknown size", None)
    assert counts == {key: value for key, value in expected.items() if key[0] != "s"}


def test_the_unit_of_time_is_that_of_the_column_not_of_one_line(tmp_path):
    lines = ["1 3 4 1\n", *(f"1.{k:06d} 3 4 1\n" for k in range(10, 5000, 10))]
    (tmp_path / "x.csv").write_text("".join(lines))
    found, recording = read(tmp_path / "x.csv")
    np.testing.assert_array_equal(
        found["t"], [1_000_000, *range(1_000_010, 1_005_000, 10)])
    assert recording.info.header["time_unit"] == "s"
    assert recording.info.format == "text, times in s"
    # One damaged time decides nothing.
    for wrong in (f"{10**18}", "2.5"):
        (tmp_path / "x.csv").write_text("".join(
            f"{wrong if k == 9 else 100 * k} 3 4 1\n" for k in range(50)))
        found, recording = read(tmp_path / "x.csv")
        assert recording.info.header["time_unit"] == "us"
        assert len(found) == 49
    # Its first 64 kB are whole seconds.
    many = "1 3 4 1\n" * 20_000 + "".join(lines)
    (tmp_path / "x.csv").write_text(many)
    assert read(tmp_path / "x.csv")[0]["t"][[0, -1]].tolist() == [1_000_000, 1_004_990]


@pytest.mark.parametrize(("text", "message"), [
    ("t_s,aop_deg,dolp,s0\n0,1,2,3\n", "named t_s, aop_deg, dolp, s0: which are time"),
    ("5 5 1 1000\n6 5 0 1001\n", r"not time, x, y, polarity, as \('5', '5', '1'"),
    ("1000 5.5 1.5 1\n", r"the order of the columns is stated by columns=")])
def test_text_of_something_else_is_refused_by_its_columns(tmp_path, text, message):
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(RecordingError, match=message):
        open_recording(tmp_path / "x.csv")


def test_text_is_never_taken_for_images(tmp_path):
    (tmp_path / "x.csv").write_text("not, events\nat, all\n")
    for layout in (None, "sony"):
        with pytest.raises(RecordingError, match="text, but no lines of events: "):
            open_recording(tmp_path / "x.csv", layout=layout)
    video = pdavis_cv.VideoCapture(str(tmp_path / "x.csv"), layout="sony")
    assert not video.isOpened()
    events = some_events(300)
    (tmp_path / "x.csv").write_bytes(b"640 480\n" + text_file(events))
    with open_recording(tmp_path / "x.csv", layout="sony") as recording:
        np.testing.assert_array_equal(recording.events(), events)


def test_columns_are_stated_where_names_do_not_say_them(tmp_path):
    (tmp_path / "x.csv").write_text("when,where_x,where_y,what,on?\n10,3,4,7,1\n")
    assert read(tmp_path / "x.csv", columns="txy_p")[0].tolist() == [(10, 3, 4, 1)]
    (tmp_path / "x.csv").write_text("10 3 4 1\n")
    with pytest.raises(RecordingError, match="5 columns are needed of at most 16, its "
                       "first line has 4"):
        open_recording(tmp_path / "x.csv", columns="_txyp")


def test_a_text_in_a_zip_archive_is_read(tmp_path):
    events = some_events(2000)
    path = tmp_path / "x.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.mkdir("run")
        archive.writestr("run/events.txt", b"640 480\n" + text_file(
            events, line="{s} {x} {y} {p}\n"))
        archive.writestr("run/README.md", "of one camera")
    found, recording = read(path)
    np.testing.assert_array_equal(found, events)
    assert recording.info.sensor_size == SIZE
    with pickle.loads(pickle.dumps(recording)) as again:
        assert len(again.events()) == 2000
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("run/images.txt", "0 1\n")
    with pytest.raises(RecordingError, match=r"one text of events .* holds 3 files: "):
        open_recording(path)


@pytest.mark.parametrize(("name", "size", "counts", "first", "last"), [
    ("e2vid_events.txt", (180, 240), (4000, 2019), (65, 6, 33, 0),
     (999_958, 40, 25, 0)),
    ("v2e_text_label1.txt", (260, 346), (3000, 1492), (1036, 106, 50, 1),
     (999_991, 337, 43, 0))])
def test_text_of_the_public_cases(data_dir, name, size, counts, first, last):
    found, recording = read(data_dir / "public" / name)
    assert recording.info.sensor_size == size
    assert (len(found), found["p"].sum()) == counts
    assert found[[0, -1]].tolist() == [first, last]


def test_lines_that_are_not_events_are_counted(tmp_path):
    (tmp_path / "x").write_bytes(b"1 2 3 1\n4 5\n6 7 8 0\nnothing\n9 1 1 -1")
    found, recording = read(tmp_path / "x")
    assert found.tolist() == [(1, 2, 3, 1), (6, 7, 8, 0), (9, 1, 1, 0)]
    assert {p.kind: p.count for p in recording.problems}["bad line"] == 2
    with pytest.raises(ValueError, match="columns must be the letters txyp"):
        open_recording(tmp_path / "x", columns="txy")
    assert main(["info", str(tmp_path / "x"), "--scan"]) == 0


@pytest.mark.parametrize(("first", "said"), [
    (17 * 10**11, "may be ms since 1970"), (10**9, ""), (17 * 10**14, ""),
    (10**11, ""), (17 * 10**17, "")])
def test_times_that_may_be_those_of_a_computer_in_ms_are_said(tmp_path, first, said):
    lines = "".join(f"{first + k},{k % 4},1,1\n" for k in range(50))
    (tmp_path / "x.csv").write_text(lines)
    with open_recording(tmp_path / "x.csv") as recording:
        assert said in "".join(p.message for p in recording.problems)
        assert any(p.kind == "time unit" for p in recording.problems) == bool(said)
    (tmp_path / "x.csv").write_text("t_ms,x,y,p\n" + lines)
    with open_recording(tmp_path / "x.csv") as recording:
        assert all(p.kind != "time unit" for p in recording.problems)
        assert recording.info.header["time_unit"] == "ms"


def test_a_shape_that_is_no_shape_is_an_error_of_the_file(tmp_path):
    np.save(tmp_path / "x.npy", np.zeros((100, 4)))
    data = (tmp_path / "x.npy").read_bytes()
    (tmp_path / "x.npy").write_bytes(data.replace(b"(100, 4)", b"(1 0, 4)"))
    with pytest.raises(RecordingError):
        open_recording(tmp_path / "x.npy")
