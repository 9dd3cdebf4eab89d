"""Every block of docs/recipes.md runs as it stands."""
import re
from pathlib import Path

import numpy as np
import pytest
from images import encoded

from pdavis_cv.data import example_recording

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "docs" / "recipes.md").read_text()
BLOCKS = re.findall(r"^```python\n(.*?)^```", TEXT, re.M | re.S)
TITLES = [re.findall(r"^## (.*)$", TEXT[:TEXT.index(block)], re.M)[-1]
          for block in BLOCKS]
PACKAGES = ("imutils", "supervision", "vidgear", "pims", "imageio", "ultralytics",
            "torch", "dask")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "run.aedat4").symlink_to(example_recording())
    encoded(tmp_path / "clip.mkv", np.random.default_rng(0).integers(
        0, 4096, (4, 64, 80), np.uint16), "ffv1", "gray16le")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_there_is_a_recipe_for_each_adapter():
    for name in PACKAGES:
        assert any(f"import {name}" in block or f"from {name}" in block
                   for block in BLOCKS)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")   # of the packages
@pytest.mark.parametrize("block", BLOCKS, ids=TITLES)
def test_recipe_runs(block, folder):
    for name in PACKAGES:
        if re.search(rf"^(import|from) {name}\b", block, re.M):
            pytest.importorskip(name)
    names = {"__name__": "recipe"}
    exec(compile(block, "recipes.md", "exec"), names)
    assert len(names) > 2       # it imports something at least
