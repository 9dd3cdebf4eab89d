"""pdavis batch --work reproduce: the experiments in parts, joined to the same rows."""
import csv

import pytest
from batch_works import Inline

from pdavis_cv import FusionOptions, batch
from pdavis_cv.tools.main import main
from pdavis_cv.tools.reproduce import parts, robustness
from pdavis_cv.tools.reproduce.page import read_rows, write_rows
from pdavis_cv.tools.reproduce.run import Row

QUICK = parts.Part(quick=True, seconds=1.2)


def row(**changes):
    values = {name: 1.5 for name in Row.columns()}
    return Row(**{**values, "scene": "s", "region": "all", "camera": "nominal",
                  "method": "cf", "seed": 3, "dolp_roi": float("nan"), **changes})


def test_parts_are_specimens_of_figures_and_cases_of_the_table():
    work = parts.Part(quick=True, seeds=(1, 4))
    assert list(parts.parts(["fig2", "dr"], work)) == [
        "fig2-1", "fig2-4", "dr-1", "dr-4"]
    assert list(parts.parts(["all"], parts.Part())) == [
        *(f"{figure}-{seed}" for figure in ("fig2", "fig3") for seed in range(1, 11)),
        "fig4a-1", "dr-1", "flicker-1"]
    count = len(robustness.robustness_cases(work.settings("robustness")))
    assert list(parts.parts(["robustness"], work)) == [
        f"robustness-{i}" for i in range(count)]


def test_what_has_no_parts_is_named(tmp_path, capsys):
    assert main(["batch", "denoise", "-o", str(tmp_path), "--work", "reproduce"]) == 2
    assert "--work reproduce does all, fig2" in capsys.readouterr().err


def test_a_dry_run_lists_the_parts(tmp_path, capsys):
    assert main(["batch", "fig2", "-o", str(tmp_path), "--work", "reproduce", "--with",
                 "seeds=2,5", "--dry-run"]) == 0
    told = capsys.readouterr().out.splitlines()
    assert [line.split()[-1] for line in told[:2]] == ["fig2-2", "fig2-5"]
    assert told[2] == "2 jobs, 0 of them done"


def test_rows_come_back_as_they_were_written(tmp_path):
    written = [row(), row(seed=4, rpm=30.0, aop_error_deg=1 / 3)]
    write_rows(tmp_path / "rows", written, {})
    assert list(map(repr, read_rows(tmp_path / "rows.csv"))) == list(
        map(repr, written))


def test_a_figure_is_made_of_one_specimen_in_the_job_s_folder(tmp_path, monkeypatch):
    def figure(name, stem, settings):
        stem.with_suffix(".md").write_text("a page")
        return "a page", [row(seed=seed, scene=name) for seed in settings.seeds]

    monkeypatch.setitem(parts.EXPERIMENTS, "dr", ("", figure))
    work = parts.Part(seeds=(2, 7))
    table = batch.run(parts.parts(["dr"], work), FusionOptions(), tmp_path, work=work,
                      executor=Inline(), progress=False)
    assert [one["files"] for one in table] == 2 * [
        ["dr.md", "rows.csv", "rows.csv.json"]]
    assert parts.join(table, tmp_path) == ["dr.csv", "figures.md"]
    with (tmp_path / "dr.csv").open(newline="") as file:
        assert [line["seed"] for line in csv.DictReader(file)] == ["2", "7"]


@pytest.mark.gate
def test_joined_rows_are_those_of_the_experiment(tmp_path):
    settings = QUICK.settings("robustness")
    table = batch.run(["robustness-0", "robustness-1"], FusionOptions(), tmp_path,
                      work=QUICK, executor=Inline(), progress=False)
    assert [one["error"] for one in table] == [""] * 2
    assert parts.join(table, tmp_path) == ["robustness.csv", "robustness.md"]
    write_rows(tmp_path / "direct", [
        one for i in (0, 1) for one in robustness.case_rows(settings, i)], {})
    assert (tmp_path / "robustness.csv").read_bytes() == (
        tmp_path / "direct.csv").read_bytes()
