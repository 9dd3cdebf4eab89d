import re
import subprocess
import sys


def block(root, language, number=0):
    text = (root / "README.md").read_text()
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)[number]


def test_the_first_block_of_the_readme_runs(root, tmp_path):
    code = block(root, "python") + "\nassert picture.shape == (260, 346, 3)\n"
    done = subprocess.run(
        [sys.executable, "-P", "-W", "error", "-c", code], cwd=tmp_path,
        capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 35


def test_every_command_line_of_the_readme_parses(root):
    from pdavis_cv.tools.main import COMMANDS
    lines = re.findall(r"`pdavis ([a-z]+)([^`]*)`", (root / "README.md").read_text())
    assert {"info", "export", "demo", "bench"} <= {name for name, _ in lines}
    assert {name for name, _ in lines} <= set(COMMANDS)


def test_every_file_that_the_readme_links_to_exists(root):
    links = re.findall(r"\]\(([^)]+)\)", (root / "README.md").read_text())
    assert links
    for link in links:
        assert link.startswith("https://") or (root / link).exists(), link
