import inspect
import re

import pytest

import pdavis_cv


def block(root, language, number=0):
    text = (root / "README.md").read_text()
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)[number]


def test_the_blocks_of_the_readme_run(root, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(block(root, "python") + block(root, "python", 1), names)
    names["capture"].release()
    assert names["ok"]
    assert names["picture"].shape == (56, 56, 3)
    degrees = [float(line.split()[1]) for line in capsys.readouterr().out.splitlines()]
    assert len(degrees) == 99
    assert 0.2 < min(degrees) < max(degrees) < 0.8


def test_the_page_of_commands_names_them_all(root):
    from pdavis_cv.tools.main import COMMANDS
    text = (root / "docs" / "tools.md").read_text()
    assert set(re.findall(r"`pdavis ([a-z]+)[^`]*`", text)) == set(COMMANDS)


def pages(root):
    """Return the pages; of the site's copies of the lab's, the originals."""
    found = [*root.glob("*.md"), *(root / "docs").rglob("*.md"),
             *(root / "lab").rglob("*.md")]
    return {page for page in found if root / "docs" / "lab" not in page.parents}


def test_pages_name_no_command_that_there_is_not(root):
    from pdavis_cv.tools.main import COMMANDS
    for page in pages(root) - {root / "CHANGELOG.md"}:
        named = re.findall(r"(?:`|^ *)pdavis ([a-z]+)\b", page.read_text(), re.M)
        assert set(named) <= set(COMMANDS), page


def test_what_pages_run_of_the_lab_can_be_run(root):
    for page in pages(root):
        text = page.read_text()
        for name in re.findall(r"python -m (lab(?:\.\w+)+)", text):
            at = root / name.replace(".", "/")
            assert (at / "__main__.py").exists() or at.with_suffix(".py").exists(), (
                page, name)
        for script in re.findall(r"python ((?:lab|tests)/[a-z\d_/]+\.py)", text):
            assert (root / script).exists(), (page, script)


def test_every_file_that_a_page_links_to_exists(root):
    for page in pages(root):
        for link, anchor in re.findall(
                r"\]\(([^)#\s]*)(?:#([^)\s]*))?[^)]*\)", page.read_text()):
            if link.startswith("https://"):
                continue
            target = page.parent / link if link else page
            assert target.exists(), (page, link)
            if anchor:
                heads = re.findall(r"^#+ (.*)$", target.read_text(), re.M)
                names = {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-")
                         for head in heads}
                assert anchor in names, (page, link, anchor)


WORDS = {"macropixel": "2x2", "redundancy": "I0 \\+ I90|three Stokes",
         "buffered": "later|next", "causal": "had arrived"}
"""Word of ours -> what its explanation holds."""


@pytest.mark.parametrize("word", WORDS)
def test_words_of_ours_are_explained_where_they_first_occur(root, word):
    from pdavis_cv.tools._common import Parser
    from pdavis_cv.tools._options import add_fuse_options
    parser = Parser("x", "", "")
    add_fuse_options(parser)
    for name, text in (("README.md", (root / "README.md").read_text()),
                       ("docs/index.md", (root / "docs/index.md").read_text()),
                       ("--help", parser.format_help().partition("options:")[2])):
        text = re.sub(r"\s+", " ", text)
        first = text.lower().find(word)
        if first >= 0:
            near = text[max(0, first - 150):first + 300]
            assert re.search(WORDS[word], near), (name, near)


def test_every_page_can_be_reached_from_the_readme(root):
    seen, waiting = set(), [root / "README.md"]
    while waiting:
        page = waiting.pop()
        if page in seen:
            continue
        seen.add(page)
        waiting += [(page.parent / link).resolve() for link in
                    re.findall(r"\]\(([^)#\s]+\.md)[^)]*\)", page.read_text())]
    missing = {page for page in pages(root) if page.parent != root} - seen
    assert not missing


def test_the_pages_that_the_site_lists_exist(root):
    text = (root / "docs" / "conf.py").read_text()
    parts = text[text.index("PARTS = {"):text.index("\n}")]
    listed = re.findall(r'"([a-z/-]+)"', parts)
    assert len(listed) > 15
    for page in listed:
        at = page.replace("lab/", "../lab/docs/")
        assert page.startswith("reference/") or (root / "docs" / f"{at}.md").exists()


def test_the_reference_has_every_public_name_with_a_docstring(root, monkeypatch):
    monkeypatch.syspath_prepend(str(root / "docs"))
    api_pages = pytest.importorskip("api_pages", reason="needs docutils")
    text = "".join(api_pages._room(room) for room in api_pages.ROOMS)
    named = set(re.findall(r"\.\. auto(?:class|function):: (\w+)", text))
    for name in pdavis_cv.__all__:
        value = getattr(pdavis_cv, name)
        assert name in named or not (inspect.isclass(value) or inspect.isroutine(value))
    options = api_pages._options()
    assert all(f"``{name}``" in options for name in pdavis_cv.METHODS)
    properties = api_pages._opencv()
    assert all(f"``{name}``" in properties for name in pdavis_cv.__all__
               if re.match("CAP_(PROP_)?PDAVIS_", name))
