"""What can go wrong with a file, for every output and every format (`faults.py`)."""
import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("resource")     # of POSIX, as fork is
HERE = Path(__file__).parent
CODES = {"killed": -9, "terminated": 130, "full": 1, "broken": 1, "stdout": 1,
         "folder": 2}


def cases(kind):
    run = subprocess.run([sys.executable, "-P", str(HERE / "faults.py"), kind],
                         capture_output=True, text=True, timeout=900, check=False)
    assert run.returncode == 0, run.stderr[-2000:]
    return [json.loads(line) for line in run.stdout.splitlines()]


@pytest.mark.gate
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/sys, /dev/full")
def test_no_fault_leaves_half_an_output():
    found = cases("writers")
    assert len(found) == 25 * len(CODES)
    for case in found:
        fault, said, left = case["fault"], case["said"], case["left"]
        if fault == "stdout" and case["code"] == 0:     # it had nothing to say
            assert (said, left) == ("", [case["output"]]), case
            continue
        assert case["code"] == CODES[fault], case
        assert case["again"] == 0, case
        if fault == "killed":       # at the last moment: nothing has its name yet
            assert left, case
            assert all(name.startswith(".") for name in left), case
            assert case["after"], case
            assert not any(name.startswith(".") for name in case["after"]), case
            continue
        # h5py prints what it cannot write once more, when it is collected.
        lines = [line for line in said.splitlines() if line.startswith("pdavis: ")
                 and not line.startswith("pdavis: warning: ")]
        assert len(lines) == 1, case
        if fault == "stdout":       # what was computed is kept
            assert not any(name.startswith(".") for name in left), case
        else:
            assert not left, case
        if fault == "terminated":
            assert "interrupted" in said, case


@pytest.mark.gate
def test_files_that_change_while_they_are_read_give_what_is_left_of_them():
    found = cases("readers")
    assert len(found) >= 4 * 10
    for case in found:
        assert case["code"] == 0, case
        assert case["said"].startswith("RecordingError") or (
            case["said"].endswith(" events\n")), case
        if case["fault"] in ("nothing", "grown"):
            assert case["said"] == "3000 events\n", case
