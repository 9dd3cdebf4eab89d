"""Many recordings: names, rows, failures, and what a run leaves behind."""
import csv
import json
import os
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor

import batch_works
import numpy as np
import pytest
from batch_works import Breaks, Inline

import pdavis_cv
from pdavis_cv import (
    ApsFrame,
    FusionOptions,
    Layout,
    batch,
    recording_from_arrays,
    write_aedat4,
)
from pdavis_cv.batch.jobs import Job, describe
from pdavis_cv.batch.results import Results
from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.tools.main import main

PLAIN = FusionOptions(method="cf", layout="pdavis")


def write(path, seed=0):
    """Write a recording of eight by eight pixels and a tenth of a second."""
    rng = np.random.default_rng(seed)
    events = np.zeros(200, pdavis_cv.EVENT_DTYPE)
    events["t"] = np.sort(rng.integers(0, 100_000, 200))
    for name in "xy":
        events[name] = rng.integers(0, 8, 200)
    frames = [ApsFrame(rng.integers(100, 900, (8, 8)).astype(np.float32),
                       40_000 * k, 40_000 * k + 10_000) for k in range(3)]
    write_aedat4(path, recording_from_arrays(
        events, frames, sensor_size=(8, 8), layout=Layout.PDAVIS))
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    return [write(folder / f"run{i}.aedat4", i) for i in range(3)]


@pytest.fixture
def three(made, tmp_path):
    return [shutil.copy(path, tmp_path) for path in made]


def run(recordings, out, options=PLAIN, **changes):
    changes = {"work": batch_works.count, "executor": Inline(), **changes}
    return batch.run(recordings, options, out, progress=False, **changes)


def files_in(out):
    return {path.relative_to(out).as_posix() for path in out.rglob("*")
            if path.is_file() and ".batch" not in path.parts}


def left_in(out):
    return [path for folder in ("parts", "claims")
            for path in (out / ".batch" / folder).iterdir()]


# ---- what is done ----------------------------------------------------------------


def test_each_recording_meets_each_set_of_options(three, tmp_path):
    options = [PLAIN.replace(fps=fps) for fps in (50, 100)]
    table = run(three, tmp_path / "out", options)
    told = [(row["recording"], row["options"]["fps"], row["state"]) for row in table]
    assert told == [
        (str(path), fps, "done") for path in three for fps in (50, 100)]
    for row in table:
        assert (tmp_path / "out" / row["name"] / "events.txt").read_text() == "200\n"
        assert row["files"] == ["events.txt"]
    assert not left_in(tmp_path / "out")


def test_a_second_run_does_nothing(three, tmp_path):
    first = list(run(three, tmp_path / "out", work=batch_works.note))
    again = Inline()
    assert list(run(three, tmp_path / "out", work=batch_works.note,
                    executor=again)) == first
    assert again.sent == 0


def test_a_copy_of_the_same_content_is_done_once(three, tmp_path):
    executor = Inline()
    (tmp_path / "other").mkdir()
    copy = shutil.copy(three[0], tmp_path / "other" / "run0.aedat4")
    assert len(run([three[0], copy], tmp_path / "out", executor=executor)) == 1
    assert executor.sent == 1


def test_a_byte_more_is_another_job(three, tmp_path):
    before = run(three[:1], tmp_path / "out")[0]["name"]
    with open(three[0], "ab") as file:
        file.write(b"\0")
    assert run(three[:1], tmp_path / "out")[0]["name"] != before


def test_what_no_result_depends_on_changes_no_name():
    plain = Job("a/run.aedat4", "sha", PLAIN, batch_works.count)
    assert plain.name.startswith("run-")
    assert Job("b/run.aedat4", "sha", PLAIN.replace(threads=4),
               batch_works.count).name == plain.name


@pytest.mark.parametrize("changed", [
    Job("a/run.aedat4", "other", PLAIN, batch_works.count),
    Job("a/run.aedat4", "sha", PLAIN.replace(fps=10), batch_works.count),
    Job("a/run.aedat4", "sha", PLAIN.replace(cutoff_hz=2.0), batch_works.count),
    Job("a/run.aedat4", "sha", PLAIN, batch_works.note),
    Job("a/run.aedat4", "sha", PLAIN, batch.Export()),
    Job("a/run.aedat4", "sha", PLAIN, batch.Export(suffix=".h5"))])
def test_what_a_result_depends_on_changes_its_name(changed):
    assert changed.name != Job("a/run.aedat4", "sha", PLAIN, batch_works.count).name


def test_a_new_version_does_its_own(monkeypatch):
    before = Job("run", "sha", PLAIN, batch_works.count).name
    monkeypatch.setattr(pdavis_cv, "__version__", "9.0")
    assert Job("run", "sha", PLAIN, batch_works.count).name != before


def test_arrays_are_described_by_what_they_hold():
    one = describe({"theta": np.ones((2, 2), np.float32)})
    assert one == describe({"theta": np.ones((2, 2), np.float32)})
    assert one != describe({"theta": np.ones((2, 2))})
    assert one != describe({"theta": np.zeros((2, 2), np.float32)})


@pytest.mark.parametrize(("work", "figures", "files"), [
    ("export", {"images": 3, "height": 8}, {"images.npz", "preview.png"}),
    ("traces", {"images": 3}, {"traces.csv", "traces.csv.json", "preview.png"}),
    ("calibrate", {"theta_on": 0.2}, {"camera.npz"})])
def test_works_write_and_tell(work, figures, files, three, tmp_path):
    row = run(three[:1], tmp_path / "out", work=work)[0]
    assert row["error"] == ""
    assert set(row["files"]) == files
    assert figures.items() <= row["figures"].items()


def test_export_writes_what_fuse_gives(three, tmp_path):
    row = run(three[:1], tmp_path / "out", work=batch.Export(start_s=0.03))[0]
    with np.load(tmp_path / "out" / row["name"] / "images.npz") as stack, \
            pdavis_cv.open_recording(three[0]) as recording:
        start = recording.info.start_us + 30_000
        images = list(pdavis_cv.fuse(recording, PLAIN, start_us=start))
        assert stack["t_us"].tolist() == [image.t_us for image in images]
        for k, image in enumerate(images):
            np.testing.assert_array_equal(
                stack["aop"][k][image.valid], image.aop[image.valid])


def test_score_tells_what_the_command_tells(data_dir, tmp_path, capsys):
    path = data_dir / "davis346.aedat4"
    row = run([path], tmp_path / "out", work=batch.Score(seconds=0.6))[0]
    assert row["error"] == ""
    main(["score", str(path), "--seconds", "0.6", "--methods", "cf", "--thresholds",
          "default", "--layout", "pdavis", "--json"])
    told = json.loads(capsys.readouterr().out)
    found = next(one for one in told["rows"] if one["method"] == "cf")
    assert row["figures"]["moving rmse"] == pytest.approx(
        found["scores"]["moving"]["rmse"], rel=1e-12)
    assert 0 < told["camera"]["thresholds_sigma"] < 0.5


# ---- what goes wrong -------------------------------------------------------------


def test_a_recording_that_fails_is_a_row(three, tmp_path):
    (tmp_path / "bad.aedat4").write_bytes(b"no recording")
    table = run([*three, tmp_path / "bad.aedat4", tmp_path / "gone.aedat4"],
                tmp_path / "out")
    assert [row["state"] for row in table] == ["done"] * 3 + ["failed"] * 2
    assert "bad.aedat4: byte 0: not a recording" in table[3]["error"]
    assert "gone.aedat4: cannot be opened" in table[4]["error"]
    assert [row["attempt"] for row in table] == [1] * 5
    assert len(table.failed) == 2


def test_what_failed_is_tried_again_by_the_next_run(three, tmp_path):
    path = tmp_path / "bad.aedat4"
    path.write_bytes(b"no recording")
    assert len(run([path], tmp_path / "out").failed) == 1
    executor = Inline()
    run([path], tmp_path / "out", executor=executor)
    assert executor.sent == 1


def test_half_a_result_leaves_nothing(three, tmp_path):
    table = run(three, tmp_path / "out", work=batch_works.half)
    assert [row["error"] for row in table] == ["damaged in the middle"] * 3
    assert files_in(tmp_path / "out") == {
        "summary.csv", "index.html", *(f"{row['name']}.json" for row in table)}
    assert not left_in(tmp_path / "out")


@pytest.mark.parametrize(("retries", "state"), [(0, "failed"), (1, "done")])
def test_an_error_that_may_pass_is_tried_again(retries, state, three, tmp_path):
    table = run(three, tmp_path / "out", work=batch_works.twice, retries=retries)
    assert [row["state"] for row in table] == [state] * 3
    assert [row["attempt"] for row in table] == [retries + 1] * 3


def test_a_job_ends_at_its_time(three, tmp_path):
    row = run(three[:1], tmp_path / "out", work=batch_works.endless, timeout_s=0.05)[0]
    assert row["error"] == "not done after 0.05 s"
    assert row["wall_s"] < 5


def test_a_thread_is_told_that_its_time_cannot_be_limited(three, tmp_path):
    with ThreadPoolExecutor(1) as executor:
        row = run(three[:1], tmp_path / "out", timeout_s=5, executor=executor)[0]
    assert "timeout_s needs jobs in main threads" in row["error"]
    assert row["attempt"] == 1


def test_damage_is_told_in_the_row(data_dir, tmp_path):
    data = bytearray((data_dir / "davis346_short.aedat4").read_bytes())
    data[200_000:260_000] = bytes(60_000)
    (tmp_path / "hurt.aedat4").write_bytes(data)
    row = run([tmp_path / "hurt.aedat4"], tmp_path / "out")[0]
    assert row["state"] == "done"
    assert row["problems"] > 0
    assert any("hurt.aedat4" in text for text in row["warnings"])


def test_what_was_assumed_is_told_in_the_row(tmp_path):
    np.save(tmp_path / "x.npy", np.full((3, 8, 12), 700, np.uint16))
    rows = [run([tmp_path / "x.npy"], tmp_path / "out",
                stated=SourceOptions(layout="sony", **known))[0]
            for known in ({"full_scale_dn": 1000}, {"source_fps": 50, "bits": 10})]
    assert [row["warnings"] for row in rows] == [["rate assumed (25 per second)"], []]


def test_a_work_must_return_figures(three, tmp_path):
    row = run(three[:1], tmp_path / "out", work=lambda *_: 3)[0]
    assert row["error"] == "a work must return a mapping of figures or None, got int"


def test_when_a_process_dies_the_others_are_done_singly(three, tmp_path):
    bad = write(tmp_path / "bad.aedat4", 9)
    log = []
    table = run([three[0], bad, *three[1:]], tmp_path / "out",
                executor=lambda: Breaks(log))
    assert [row["state"] for row in table] == ["done", "failed", "done", "done"]
    assert "died" in table[1]["error"]
    assert table[1]["attempt"] == 2
    # Four at a time; then each of those that were there, until the bad one has died
    # of its own twice.
    assert log == [["run0", "bad", "run1", "run2"], ["bad"], ["run1", "run2", "bad"]]


def test_no_more_is_submitted_than_workers_have_use_for(tmp_path):
    waiting, most = [0], [0]

    class Counts(Inline):
        def submit(self, *args, **kwargs):
            waiting[0] += 1
            most[0] = max(most[0], waiting[0])
            future = super().submit(*args, **kwargs)
            return future

    def names():
        for i in range(50):
            yield f"part{i}"
            waiting[0] -= i >= 4
    table = run(names(), tmp_path / "out", work=batch_works.nothing, workers=2,
                executor=Counts())
    assert len(table) == 50
    assert most[0] <= 6


# ---- two at once -----------------------------------------------------------------


def test_two_runs_share_the_jobs(three, tmp_path):
    tables = []

    def one():
        tables.append(run(three, tmp_path / "out", work=batch_works.note))

    threads = [threading.Thread(target=one) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [len(table.failed) for table in tables] == [0, 0]
    for path in three:
        log = path.replace(".aedat4", ".log")
        with open(log) as file:
            assert file.read() == "done\n"


def test_a_claim_belongs_to_one_run(tmp_path):
    results = Results(tmp_path)
    results.begin()
    claim = results.claim("job")
    assert results.claim("job") is None
    claim.release()
    other = results.claim("job")
    assert other is not None
    claim.release()                         # a second time: not the other's
    assert results.claim("job") is None
    other.release()


def test_what_a_killed_process_left_is_removed(three, tmp_path):
    out = tmp_path / "out"
    name = run(three[:1], out)[0]["name"]
    (out / f"{name}.json").unlink()         # killed before its marker
    left = out / ".batch" / "parts" / f"{name}.0badcafe"
    left.mkdir()
    (left / "half.bin").write_bytes(b"12")
    assert run(three[:1], out)[0]["state"] == "done"
    assert not left_in(out)


# ---- the table -------------------------------------------------------------------


def test_the_table_is_written_as_csv(three, tmp_path):
    (tmp_path / "bad.aedat4").write_bytes(b"no")
    options = [PLAIN, PLAIN.replace(cutoff_hz=2.0)]
    table = run([*three, tmp_path / "bad.aedat4"], tmp_path / "out", options)
    with (tmp_path / "out" / "summary.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["recording"] for row in rows] == [row["recording"] for row in table]
    assert tuple(rows[0]) == table.columns
    assert rows[0]["events"] == "200"
    assert rows[0]["mean"] == rows[0]["cutoff_hz"] == rows[0]["error"] == ""
    assert rows[1]["cutoff_hz"] == "2.0"
    assert rows[-1]["state"] == "failed"
    assert rows[-1]["error"]


def test_the_page_shows_rows_and_asks_nobody(three, tmp_path):
    (tmp_path / "<bad>.aedat4").write_bytes(b"no")
    table = run([three[0], tmp_path / "<bad>.aedat4"], tmp_path / "out", work="export")
    page = (tmp_path / "out" / "index.html").read_text()
    assert f'src="{table[0]["name"]}/preview.png"' in page
    assert "&lt;bad&gt;" in page
    assert "<bad>" not in page
    assert "http:" not in page
    assert "https:" not in page
    assert page.count("<tr class=") == 2


def test_a_marker_says_where_the_numbers_come_from(three, tmp_path):
    name = run(three[:1], tmp_path / "out")[0]["name"]
    facts = json.loads((tmp_path / "out" / f"{name}.json").read_text())["provenance"]
    assert len(facts["content"]) == 64
    assert facts["options"] == {
        "method": "cf", "layout": f"{Layout.PDAVIS} of pdavis"}
    assert facts["work"]["function"] == "batch_works:count"
    assert facts["pdavis_cv"] == pdavis_cv.__version__


def test_status_counts(three, tmp_path):
    run(three, tmp_path / "out")
    run(three[:1], tmp_path / "out", work=batch_works.half)
    found = batch.status(tmp_path / "out")
    assert len(found) == 4
    assert [row["error"] for row in found.failed] == ["damaged in the middle"]


def test_status_of_a_folder_without_results_says_so(tmp_path):
    with pytest.raises(FileNotFoundError, match="no results of pdavis batch"):
        batch.status(tmp_path)


# ---- words -----------------------------------------------------------------------


@pytest.mark.parametrize(("changes", "words"), [
    ({"work": "dance"}, "work must be one of export, traces, score, calibrate"),
    ({"executor": "slurm"}, "executor must be process, dask:tcp"),
    ({"executor": "os:nothing"}, "executor must be process, dask:tcp"),
    ({"retries": -1}, "retries must be at least 0"),
    ({"workers": 0}, "workers at least 1"),
    ({"timeout_s": 0.0}, "timeout_s must be positive")])
def test_wrong_words_are_refused(changes, words, tmp_path):
    with pytest.raises(ValueError, match=words):
        run([], tmp_path / "out", **changes)


def test_works_check_their_words():
    with pytest.raises(ValueError, match="suffix must be one of"):
        batch.Export(suffix=".gif")
    with pytest.raises(ValueError, match="quantity must be one of"):
        batch.Export(quantities=("charm",))


# ---- the command -----------------------------------------------------------------


def test_the_command_sets_every_value_with_every_other(three, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["batch", *map(str, three), "-o", str(out), "--set", "method=cf,frames",
             "--set", "fps=50,100", "--set", "layout=135/90/0/45", "--executor",
             "batch_works:Inline", "--work", "batch_works:count"]
    assert main([*words, "--dry-run"]) == 0
    assert capsys.readouterr().out.endswith("12 jobs, 0 of them done\n")
    assert not out.exists()
    assert main(words) == 0
    assert "12 jobs, 0 failed" in capsys.readouterr().out
    assert main([*words, "--json", "--progress"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out) == {"out": str(out), "jobs": 12, "failed": []}
    assert "12/12" in printed.err
    assert main([*words, "--dry-run", "--json"]) == 0
    assert all(job["done"] for job in json.loads(capsys.readouterr().out)["jobs"])
    assert main(["batch", "status", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["done"] == 12
    assert main([*words, "--dry-run"]) == 0
    assert capsys.readouterr().out.endswith("12 jobs, 12 of them done\n")
    assert main(["batch", "status", str(out)]) == 0
    assert "12 done, 0 failed" in capsys.readouterr().out


def test_the_command_tells_what_failed(tmp_path, capsys):
    (tmp_path / "bad.aedat4").write_bytes(b"no recording")
    assert main(["batch", str(tmp_path / "bad.aedat4"), "-o", str(tmp_path / "out"),
                 "--executor", "batch_works:Inline"]) == 1
    out = capsys.readouterr().out
    assert "not a recording, first bytes" in out
    assert "1 jobs, 1 failed" in out


@pytest.mark.parametrize(("words", "message"), [
    (["--set", "start=1"], "start is a time in one recording"),
    (["--set", "demosaic=fine"], "demosaic must be one of"),
    (["--set", "fps=fast"], "fps: must be a number without a unit, got 'fast'"),
    (["--work", "dance"], "--work must be one of"),
    (["--work", "os:nothing"], "--work os:nothing"),
    (["--with", "colour=red"], "--with colour: export has start_s, stop_s, suffix"),
    (["--executor", "slurm"], "executor must be process, dask:tcp")])
def test_the_command_refuses_in_one_line(words, message, three, tmp_path, capsys):
    assert main(["batch", three[0], "-o", str(tmp_path / "out"), *words]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_settings_of_the_work_reach_it(three, tmp_path):
    out = tmp_path / "out"
    assert main(["batch", three[0], "-o", str(out), "--executor", "batch_works:Inline",
                 "--set", "layout=pdavis", "--with", "suffix=.h5", "--with",
                 "quantities=aop", "--with", "stop_s=0.05"]) == 0
    names = Results(out).names()
    assert (out / names[0] / "images.h5").exists()


@pytest.mark.parametrize("text", [
    "", "null", "[]", "{}", '{"row": {}}', '{"row": []}', "[" * 100_000, "\ufeff{}",
    '{"row": {"state": "done"}}', "pipe"])
def test_a_damaged_marker_is_a_job_that_failed_and_is_done_again(
        text, three, tmp_path):
    before = [dict(row) for row in run(three, tmp_path / "out")]
    marker = next((tmp_path / "out").glob("*.json"))
    marker.unlink()
    if text == "pipe":
        os.mkfifo(marker)
    else:
        marker.write_text(text)
    table = batch.status(tmp_path / "out")
    table.write()
    assert [row["error"] for row in table.failed] == ["its marker is damaged"]
    again = run(three, tmp_path / "out")
    assert [row["state"] for row in again] == ["done"] * len(before)
    assert json.loads(marker.read_text())["row"]["state"] == "done"
