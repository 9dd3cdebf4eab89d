"""The recipes of docs/batch.md run as they stand, or as far as they can here."""
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from test_batch import write

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "docs" / "batch.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, re.M | re.S)


def the(language, holding):
    found = [block for block in blocks(language) if holding in block]
    assert len(found) == 1
    return found[0]


def run_as_script(block, folder):
    write(folder / "run.aedat4")
    (folder / "script.py").write_text(block)
    return subprocess.run(
        [sys.executable, "-P", "script.py"], cwd=folder, check=True, text=True,
        capture_output=True, timeout=120).stdout


@pytest.mark.gate
def test_a_dask_cluster_of_two_workers(tmp_path):
    pytest.importorskip("distributed")
    assert run_as_script(the("python", "LocalCluster"), tmp_path) == "['done']\n"


@pytest.mark.gate
def test_slurm_is_asked_for_workers(tmp_path):
    pytest.importorskip("dask_jobqueue")
    script = run_as_script(the("python", "SLURMCluster"), tmp_path)
    for line in ("#SBATCH -p batch", "#SBATCH --mem=2G", "#SBATCH -t 08:00:00",
                 "source $HOME/pdavis/bin/activate"):
        assert line in script.splitlines()
    assert "dask_worker" in script
    subprocess.run(["bash", "-n"], input=script, text=True, check=True)


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_an_array_of_slurm_jobs_shares_the_files(tmp_path):
    """With 100 tasks each of 250 files is given to one of them, once."""
    script = the("sh", "#SBATCH --array")
    (tmp_path / "recordings").mkdir()
    for i in range(250):
        (tmp_path / "recordings" / f"run{i:03}.aedat4").touch()
    told = "pdavis() { printf '%s\\n' \"$@\"; }\n" + script
    given = []
    for task in (0, 49, 50, 99):
        out = subprocess.run(
            ["bash"], input=told, text=True, check=True, capture_output=True,
            cwd=tmp_path, env={"SLURM_ARRAY_TASK_ID": str(task)}).stdout.split()
        given.append([Path(word).stem for word in out if word.endswith(".aedat4")])
    assert given == [["run000", "run100", "run200"], ["run049", "run149", "run249"],
                     ["run050", "run150"], ["run099", "run199"]]


def test_the_container_installs_extras_that_there_are():
    lines = the("dockerfile", "FROM").splitlines()
    assert lines[0].startswith("FROM python:3.")
    assert 'ENTRYPOINT ["pdavis"]' in lines
    wanted = re.search(r"\[([a-z0-9,]+)\]\"", "".join(lines))[1].split(",")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert set(wanted) <= project["optional-dependencies"].keys()
    assert "pdavis" in project["scripts"]
