"""Many recordings in processes that are killed, interrupted, or somebody else's."""
import hashlib
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import batch_works
import pytest
from test_batch import PLAIN, files_in, run, write

from pdavis_cv import PdavisWarning

pytestmark = pytest.mark.gate

SCRIPT = """
import signal
import sys
import batch_works
from pdavis_cv import FusionOptions, batch

if __name__ == "__main__":
    # jobs in the background are started deaf to SIGINT
    signal.signal(signal.SIGINT, signal.default_int_handler)
    batch.run(sys.argv[2:], FusionOptions(method="cf", layout="pdavis"), sys.argv[1],
              work=batch_works.slow, workers=2, progress=False)
"""


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    return [write(folder / f"run{i:02}.aedat4", i) for i in range(18)]


@pytest.fixture
def started(many, tmp_path):
    """Start a run of 18 slow jobs in a process of its own, as a terminal would."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    begun = []

    def start():
        child = subprocess.Popen(
            [sys.executable, "-P", str(script), str(tmp_path / "out"),
             *map(str, many)], start_new_session=True, stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)})
        begun.append(child)
        return child

    yield start, tmp_path / "out"
    for child in begun:
        child.stderr.close()
        child.wait()


def until(true, seconds=180):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def markers(out):
    return list(out.glob("run*.json"))


def of_session(session):
    """Return the processes of a session: a run, its workers and what serves them."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == session and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found


def assert_whole(out, count):
    """Every job has its row and its whole result; nothing else is there."""
    done = [path.stem for path in markers(out)]
    assert len(done) == count
    assert files_in(out) == {
        "summary.csv", "index.html", *(f"{name}.json" for name in done),
        *(f"{name}/events.txt" for name in done)}
    for name in done:
        assert (out / name / "events.txt").read_text() == "half and half\n"


def test_a_worker_is_killed_and_a_file_is_damaged(many, tmp_path):
    bad, hurt = tmp_path / "bad.aedat4", tmp_path / "hurt.aedat4"
    bad.write_bytes(many[0].read_bytes() + b"\0")
    hurt.write_bytes(many[1].read_bytes()[:40])
    files = [*many[:8], bad, *many[8:15], hurt, many[15]]
    table = run(files, tmp_path / "out", work=batch_works.deadly, executor=None,
                workers=2)
    assert {Path(row["recording"]).stem for row in table.failed} == {"bad", "hurt"}
    assert "died" in table[8]["error"]
    assert [row["figures"] for row in table if row["state"] == "done"] == (
        [{"events": 200, "mean": None}] * 16)


def test_among_18_a_worker_is_killed_once_and_a_file_is_damaged(many, tmp_path):
    unlucky, hurt = tmp_path / "unlucky.aedat4", tmp_path / "hurt.aedat4"
    unlucky.write_bytes(many[0].read_bytes() + b"\0")
    hurt.write_bytes(many[1].read_bytes()[:40])
    files = [*many[:8], unlucky, *many[8:15], hurt, many[15]]
    out = tmp_path / "out"
    table = run(files, out, work=batch_works.killed_once, executor=None, workers=2)
    assert [Path(row["recording"]).stem for row in table.failed] == ["hurt"]
    assert "hurt.aedat4" in table.failed[0]["error"]
    right = [row for row in table if row["state"] == "done"]
    assert len(right) == 17
    assert {name.rpartition("/")[2] for name in files_in(out) if "/" in name} == {
        "events.txt"}


@pytest.fixture
def hold(many):
    """Hold the later half of the jobs back until this file is gone."""
    path = Path(many[0]).with_name("hold")
    path.touch()
    yield path
    path.unlink(missing_ok=True)


def test_a_parent_is_killed_and_called_again(started, hold):
    start, out = started
    child = start()
    until(lambda: len(markers(out)) >= 3)
    child.kill()
    until(lambda: not of_session(child.pid), 30)    # its workers went with it
    before = {path: path.stat().st_mtime_ns for path in markers(out)}
    hold.unlink()
    assert 3 <= len(before) < 18
    for path in before:
        assert (out / path.stem / "events.txt").read_text() == "half and half\n"
    assert start().wait() == 0
    assert_whole(out, 18)
    assert all(path.stat().st_mtime_ns == then for path, then in before.items())


def test_an_interrupt_ends_it_and_it_goes_on(started, hold):
    start, out = started
    child = start()
    until(lambda: len(markers(out)) >= 1)
    os.killpg(child.pid, signal.SIGINT)
    child.wait(60)
    until(lambda: not of_session(child.pid), 30)
    before = len(markers(out))
    hold.unlink()
    assert before < 18
    assert start().wait() == 0
    assert_whole(out, 18)


def test_two_runs_at_once_do_each_job_once(started):
    start, out = started
    both = [start(), start()]
    assert [child.wait() for child in both] == [0, 0]
    assert_whole(out, 18)


def test_a_full_disk_leaves_no_half_file(many, tmp_path):
    """Files may not grow beyond a limit, as where a disk is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1500, before[1]))
    try:
        with pytest.warns(PdavisWarning, match="html: the table was not written"):
            table = run(many[:3], tmp_path / "out", work="export")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert len(table.failed) == 3
    assert all("File too large" in row["error"] for row in table)
    assert files_in(tmp_path / "out") <= {
        "summary.csv", "index.html", *(f"{row['name']}.json" for row in table)}
    assert not run(many[:3], tmp_path / "out", work="export").failed


def content(out):
    return {name: hashlib.sha256((out / name).read_bytes()).hexdigest()
            for name in files_in(out)
            if "/" in name}


def test_dask_gives_the_same_files(many, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1,
                                  dashboard_address="127.0.0.1:0") as cluster:
        for name, where in (("process", None),
                            ("dask", f"dask:{cluster.scheduler_address}")):
            table = run(many[:6], tmp_path / name, work="export", executor=where,
                        workers=2)
            assert not table.failed
    assert content(tmp_path / "process") == content(tmp_path / "dask")
    assert len(content(tmp_path / "dask")) == 12


def test_200_jobs_that_are_done_take_less_than_a_second(many, tmp_path):
    options = [PLAIN.replace(cutoff_hz=1 + k / 10) for k in range(12)]
    run(many[:17], tmp_path / "out", options, work=batch_works.count)
    begin = time.process_time()
    assert len(run(many[:17], tmp_path / "out", options, work=batch_works.count,
                   executor=None)) == 204
    assert time.process_time() - begin < 1


def test_the_parent_needs_no_more_memory_for_more_jobs(tmp_path):
    code = """
import resource, sys
import batch_works
from pdavis_cv import FusionOptions, batch

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

options = FusionOptions(method="cf")
for count in (200, 5_000):
    table = batch.run((f"part{i}" for i in range(count)), options, sys.argv[1],
                      work=batch_works.nothing, executor=batch_works.Inline(),
                      progress=False)
    print(len(table), peak())
"""
    told = subprocess.run(
        [sys.executable, "-P", "-c", code, str(tmp_path / "out")], check=True,
        capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)}).stdout.split()
    assert told[0::2] == ["200", "5000"]
    assert float(told[3]) - float(told[1]) < 9      # MiB; rows would take 15
