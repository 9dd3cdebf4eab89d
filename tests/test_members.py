"""Members: the files that a source is made of, whatever names it."""
import hashlib
import json

import numpy as np
import pytest
from test_aedat4_writer import small

import pdavis_cv
from pdavis_cv import batch, open_recording
from pdavis_cv.batch.results import Results
from pdavis_cv.recording.members import members_of
from pdavis_cv.tools.main import main

cv2 = pytest.importorskip("cv2")
NAMES = [f"shot_{k}.png" for k in range(9, 12)]


@pytest.fixture
def shots(tmp_path):
    """Write three images whose alphabetic order is not that of their numbers."""
    rng = np.random.default_rng(0)
    for name in NAMES:
        cv2.imwrite(str(tmp_path / name), rng.integers(90, 200, (8, 12), np.uint8))
    return tmp_path


@pytest.mark.parametrize("source", ["shot_*.png", "shot_9.png", NAMES])
def test_a_recording_names_its_files(shots, source):
    where = [shots / name for name in source] if source is NAMES else shots / source
    expected = NAMES if source != "shot_9.png" else [source]
    with open_recording(where, layout="sony") as recording:
        assert [member.path.name for member in recording.members] == expected
        assert [member.path for member in members_of(where)] == [
            shots / name for name in expected]
        first = recording.members[0]
        data = (shots / "shot_9.png").read_bytes()
        assert (first.size, first.sha256) == (
            len(data), hashlib.sha256(data).hexdigest())


def test_a_folder_has_its_files_and_memory_has_none(shots):
    assert {member.path.name for member in members_of(shots)} == set(NAMES)
    assert small().members == ()


@pytest.mark.parametrize("suffix", [".npy", ".ome.tif", ".npz", ".png", ".webm", ".h5"])
def test_every_output_says_which_files_it_is_made_of(shots, suffix, capsys):
    if suffix == ".h5":
        pytest.importorskip("h5py")
    out = shots / f"out{suffix}"
    assert main(["export", *(str(shots / name) for name in sorted(NAMES)),
                 "--layout", "sony", "-o", str(out)]) == 0, capsys.readouterr().err
    if suffix == ".npy":
        facts = json.loads((shots / "out.npy.json").read_text())["provenance"]
        assert [one["name"] for one in facts["input"]["files"]] == NAMES
        with open_recording(shots / "shot_*.png", layout="sony") as recording:
            image = next(pdavis_cv.fuse(recording))
        np.testing.assert_array_equal(np.load(out)[0, 1], image.aop)


def test_no_output_replaces_a_file_that_is_read(shots, capsys):
    assert main(["export", str(shots / "shot_*.png"), "--layout", "sony", "--at", "0",
                 "-o", str(shots / "shot_10.png")]) == 2
    assert "is the recording that is read" in capsys.readouterr().err
    assert main(["export", f"replay:{shots / 'shot_9.png'}", "--layout", "sony",
                 "-o", str(shots / "shot_9.png")]) == 2
    assert "is the recording that is read" in capsys.readouterr().err


def test_only_images_are_one_recording_together(shots, capsys):
    pdavis_cv.write_aedat4(shots / "run.aedat4", small())
    assert main(["info", str(shots / "run.aedat4"), str(shots / "shot_9.png")]) == 2
    assert "only images are one recording" in capsys.readouterr().err


def test_a_batch_knows_a_pattern_by_the_content_of_its_files(shots, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    results = Results(out)
    results.begin()
    before = results.identity(str(shots / "shot_*.png"))
    assert not before.startswith("unread")
    table = batch.run([str(shots / "shot_*.png")],
                      pdavis_cv.FusionOptions(layout="sony"), out, workers=1)
    assert [row["state"] for row in table] == ["done"]
    cv2.imwrite(str(shots / "shot_9.png"), np.zeros((8, 12), np.uint8))
    assert results.identity(str(shots / "shot_*.png")) != before
