"""What must hold of the files as such."""
import re
import subprocess
from pathlib import Path

import pytest

LINES_PER_FILE = 600
MACHINE_PATH = re.compile(r"(?<![\w.>])/(?:home|root|work|Users)/\w|[A-Z]:\\Users")


@pytest.fixture(scope="module")
def tracked(root):
    if not (root / ".git").exists():
        pytest.skip("not a checkout")
    names = subprocess.run(["git", "ls-files", "-z"], cwd=root, check=True,
                           capture_output=True, text=True).stdout
    return [root / name for name in names.split("\0")
            if name and (root / name).is_file()]


def text_of(path):
    try:
        return path.read_text("utf-8")
    except UnicodeDecodeError:
        return ""


def test_no_tracked_file_names_a_machine_path(tracked, root):
    own = [str(root) + "/", str(Path.home()) + "/"]
    found = [f"{path.relative_to(root)}:{i}: {line.strip()[:80]}"
             for path in tracked
             for i, line in enumerate(text_of(path).splitlines(), 1)
             if MACHINE_PATH.search(line) or any(p in line for p in own)]
    assert not found


def test_the_path_check_sees_one():
    assert MACHINE_PATH.search("open('/" + "home/me/x.aedat4')")
    assert not MACHINE_PATH.search("https://example.org/home/x")


def test_no_source_file_is_longer_than_600_lines(tracked, root):
    long = {str(path.relative_to(root)): lines for path in tracked
            if path.suffix in (".py", ".pyx", ".pxd", ".h", ".pyi")
            and (lines := len(text_of(path).splitlines())) > LINES_PER_FILE}
    assert not long


def test_no_kernel_line_is_longer_than_88_characters(tracked, root):
    long = [f"{path.relative_to(root)}:{i}" for path in tracked
            if path.suffix in (".pyx", ".pxd", ".pyi")
            for i, line in enumerate(text_of(path).splitlines(), 1) if len(line) > 88]
    assert not long
