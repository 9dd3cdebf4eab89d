import re
import subprocess
import sys


def block(root, language, number=0):
    text = (root / "README.md").read_text()
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)[number]


def test_the_first_block_of_the_readme_runs(root, tmp_path):
    code = block(root, "python") + "\nassert picture.shape == (56, 56, 3)\n"
    done = subprocess.run(
        [sys.executable, "-P", "-W", "error", "-c", code], cwd=tmp_path,
        capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 198


def test_the_page_of_commands_names_them_all(root):
    from pdavis_cv.tools.main import COMMANDS
    text = (root / "docs" / "tools.md").read_text()
    assert set(re.findall(r"`pdavis ([a-z]+)[^`]*`", text)) == set(COMMANDS)


def test_pages_name_no_command_that_there_is_not(root):
    from pdavis_cv.tools.main import COMMANDS
    for page in [root / "README.md", *(root / "docs").rglob("*.md")]:
        named = re.findall(r"(?:`|^ *)pdavis ([a-z]+)\b", page.read_text(), re.M)
        assert set(named) <= set(COMMANDS), page


def test_every_file_that_a_page_links_to_exists(root):
    for page in [root / "README.md", *(root / "docs").rglob("*.md")]:
        for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text()):
            assert link.startswith("https://") or (page.parent / link).exists(), (
                page, link)


def test_every_page_can_be_reached_from_the_readme(root):
    seen, waiting = set(), [root / "README.md"]
    while waiting:
        page = waiting.pop()
        if page in seen:
            continue
        seen.add(page)
        waiting += [(page.parent / link).resolve() for link in
                    re.findall(r"\]\(([^)#\s]+\.md)[^)]*\)", page.read_text())]
    missing = set((root / "docs").rglob("*.md")) - seen
    assert not missing
