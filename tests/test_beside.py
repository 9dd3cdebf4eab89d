"""Files that appear under their name only when they are whole."""
import os
import subprocess
import sys

import pytest

from pdavis_cv._beside import Unfinished, write_beside


def test_a_file_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "x.png"
    path.write_text("old")
    with write_beside(path) as part:
        assert part.parent == tmp_path
        assert part.suffix == ".png"
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_block_that_raises_leaves_what_was_there(tmp_path):
    path = tmp_path / "x.png"
    path.write_text("old")

    def interrupted():
        with write_beside(path) as part:
            part.write_text("new")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_errors_name_the_final_file(tmp_path):
    missing = tmp_path / "none" / "x.png"
    with pytest.raises(FileNotFoundError) as error, write_beside(missing) as part:
        part.write_text("")
    assert error.value.filename == str(missing)
    with pytest.raises(OSError, match=r"x\.png: odd") as error, write_beside(
            tmp_path / "x.png"):
        raise OSError("odd")


def test_errors_of_other_files_keep_their_names(tmp_path):
    with pytest.raises(FileNotFoundError) as error, write_beside(tmp_path / "x"):
        (tmp_path / "source").read_text()
    assert error.value.filename == str(tmp_path / "source")


def test_what_was_never_written_can_be_given_up(tmp_path):
    Unfinished(tmp_path / "x").discard()
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name != "posix", reason="asks which processes live")
def test_what_a_killed_process_left_is_removed_and_what_a_living_one_writes_stays(
        tmp_path):
    gone = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"],
                          capture_output=True, text=True, check=True).stdout.strip()
    stay = [f".x.part{os.getppid()}.npy", f".y.part{gone}.npy", f"x.part{gone}.npy"]
    for name in [*stay, f".x.part{gone}.npy", f".x.part{gone}.mkv"]:
        (tmp_path / name).write_text("")
    with write_beside(tmp_path / "x.npy") as part:
        part.write_text("whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*stay, "x.npy"])
