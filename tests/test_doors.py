"""The examples of CONTRIBUTING.md as another package: each goes through every door."""
import os
import re
import subprocess
import sys
import tomllib

import numpy as np
import pytest
from test_aedat4 import joined
from test_aedat4_writer import small

import pdavis_cv
from pdavis_cv import FORMATS, METHODS, QUANTITIES, SOURCES, Layout, VideoCapture
from pdavis_cv.data import example_recording
from pdavis_cv.export import to_xarray
from pdavis_cv.tools import score
from pdavis_cv.tools.main import main
from pdavis_cv.viewer.panes import palettes, pane, planes
from pdavis_cv.viewer.show import show_of


def install(site, groups, modules):
    """Lay a package out as pip would."""
    facts = site / "mine-1.0.dist-info"
    facts.mkdir(parents=True)
    for name, text in modules.items():
        (site / name).write_text(text)
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (facts / "entry_points.txt").write_text("".join(
        f"[{group}]\n" + "".join(f"{name} = {what}\n" for name, what in points.items())
        for group, points in groups.items()))


@pytest.fixture
def mine(root, tmp_path, monkeypatch):
    """Install the examples of CONTRIBUTING.md."""
    page = (root / "CONTRIBUTING.md").read_text()
    [points] = re.findall(r"```toml\n(.*?)```", page, re.S)
    modules = {text.split()[1]: text
               for text in re.findall(r"```python\n(.*?)```", page, re.S)}
    site = tmp_path / "site"
    install(site, tomllib.loads(points)["project"]["entry-points"], modules)
    monkeypatch.syspath_prepend(str(site))
    yield site
    for name in modules:
        sys.modules.pop(name.removesuffix(".py"), None)


def told(capsys, *words):
    assert main(words) == 0
    return capsys.readouterr().out


def test_a_format_is_read_by_name_of_nothing_but_its_bytes(mine, tmp_path, capsys):
    events = joined(small().packets())[0]
    path = tmp_path / "x.bin"
    path.write_bytes(b"MINE" + events.tobytes())
    with pdavis_cv.open_recording(path) as recording:
        np.testing.assert_array_equal(recording.events(), events)
    with VideoCapture(path, layout=Layout.PDAVIS, fps=100) as capture:
        assert capture.read()[0] or capture.last_error is None
    assert "Mine" in told(capsys, "info", str(path), "--layout", "pdavis")
    assert list(FORMATS)[-1] == "mine"


def test_a_method_goes_through_every_door(mine, tmp_path, capsys):
    path = str(example_recording())
    with pdavis_cv.open_recording(path, layout="pdavis") as recording:
        options = {"demosaic": "superpixel", "extinction_ratio": None}
        held = list(pdavis_cv.fuse(recording, method="frames", hold="mid", **options))
        mine = list(pdavis_cv.fuse(recording, method="smooth", weight=0.25, **options))
    floor = [np.maximum(image.quad, 0.01) for image in (*held[:2], mine[1])]
    bright = held[0].valid & held[1].valid
    np.testing.assert_allclose(
        floor[2][:, bright], (floor[0]**0.75 * floor[1]**0.25)[:, bright], rtol=1e-3)
    assert METHODS["smooth"].method == mine[0].provenance["method"] == "smooth"
    with VideoCapture(path, layout=Layout.PDAVIS, method="smooth", weight=0.25,
                      output="i0", **options) as capture:
        np.testing.assert_array_equal(capture.read()[1], mine[0].quad[0])
    out = tmp_path / "x.npy"
    assert main(["export", path, "-o", str(out), "--layout", "pdavis", "--method",
                 "smooth", "--set", "weight=0.25", "--quantities", "i0",
                 "--demosaic", "superpixel"]) == 0
    np.testing.assert_array_equal(
        np.load(out)[1, 0][bright], mine[1].quad[0][bright])
    capsys.readouterr()
    for command in ("export", "view", "fan", "tendon"):
        assert "smooth" in told(capsys, command, "--help"), command
    show = show_of(path, tmp_path, {"layout": "pdavis"})
    try:
        assert show.status()["methods"][-1] == "smooth"
        show.command("method", "smooth")
        assert show.status()["method"] == "smooth"
    finally:
        show.close()


def test_a_method_is_scored_beside_the_others(mine, capsys):
    assert "'smooth'" in told(capsys, "score", "--help")
    assert score.trials()["smooth"] == score.Trial(
        {"method": "smooth"}, causal=True, thresholds=False)


def test_a_source_is_opened_by_its_address(mine, tmp_path, capsys):
    with pdavis_cv.open_source("blink:left?hz=50&seconds=0.1") as source:
        assert source.name == "blink:left?hz=50&seconds=0.1"
        found = joined(source.packets())[0]
    assert len(found) == 10 * 256
    np.testing.assert_array_equal(np.unique(found["t"]), np.arange(10) * 10_000)
    with pytest.raises(pdavis_cv.DeviceError, match="no 'rpm'; it takes hz, seconds"):
        pdavis_cv.open_source("blink:?rpm=3")
    with VideoCapture("blink:?hz=50&seconds=0.2", fps=50) as capture:
        assert capture.read()[0], capture.last_error
    assert list(SOURCES)[-1] == "blink"
    assert "2,560" in told(capsys, "info", "blink:?hz=50&seconds=0.1")


def test_a_quantity_goes_through_every_door(mine, tmp_path, capsys):
    path = str(example_recording())
    options = {"layout": Layout.PDAVIS, "method": "cf", "fps": 50}
    with pdavis_cv.open_recording(path) as recording:
        images = list(pdavis_cv.fuse(recording, **options))
    image = images[0]
    i0, _, i90, _ = image.quad
    want = (i0 - i90) / np.maximum(i0 + i90, 1e-6)
    assert list(QUANTITIES)[-1] == "contrast"
    for name in ("contrast", "q"):
        with VideoCapture(path, output=name, **options) as capture:
            np.testing.assert_allclose(capture.read()[1], want, rtol=1e-6)
            number = int(capture.get(pdavis_cv.CAP_PROP_PDAVIS_OUTPUT))
            np.testing.assert_array_equal(
                capture.retrieve(None, number)[1], capture.retrieve(None, name)[1])
            drawn = capture.retrieve(None, "contrast_bgr")[1]
    np.testing.assert_array_equal(
        drawn, pdavis_cv.render.dolp_bgr(want + 1, image.valid, top=2))
    np.testing.assert_allclose(
        to_xarray(images, ["contrast"])["contrast"][0],
        np.where(image.valid, want, np.nan), rtol=1e-6)
    words = ("export", path, "--layout", "pdavis", "--method", "cf", "--fps", "50",
             "--quantities", "s0,q")
    told(capsys, *words, "-o", str(tmp_path / "x.npz"))
    with np.load(tmp_path / "x.npz") as stack:
        np.testing.assert_allclose(
            stack["contrast"][0], np.where(image.valid, want, np.nan), rtol=1e-6)
    told(capsys, *words, "-o", str(tmp_path / "x.png"), "--range", "contrast=0,1")
    assert (tmp_path / "x-00000.png").stat().st_size > 10_000
    assert "contrast" in told(capsys, "export", "--help")
    told(capsys, "batch", path, "-o", str(tmp_path / "out"), "--set", "method=cf",
         "--set", "layout=pdavis", "--with", "quantities=contrast", "--jobs", "1")
    [made] = (tmp_path / "out").rglob("images.npz")
    with np.load(made) as stack:
        assert "contrast" in stack
    show = show_of(path, tmp_path, options)
    try:
        _, shown = show.latest(0, 1)
        assert palettes()["quantities"][-1] == {
            "name": "contrast", "symbol": "contrast",
            "title": "contrast of 0 and 90 degrees", "unit": "1",
            "ends": ["-1", "1"], "colours": "viridis"}
        part = planes(["contrast"], show, shown)["contrast"][shown.valid]
        i0, _, i90, _ = shown.quad[:, shown.valid]
        np.testing.assert_allclose(
            part, 127 * (1 + (i0 - i90) / np.maximum(i0 + i90, 1e-6)).clip(0, 2),
            atol=1.01)
        assert pane("contrast_bgr", show, shown).shape == (*shown.shape, 3)
    finally:
        show.close()


def test_what_is_broken_stops_nobody_and_is_told_by_name(tmp_path):
    site = tmp_path / "site"
    groups = ("formats", "methods", "sources", "quantities")
    install(site, {f"pdavis_cv.{kind}": {"broken": "broken_module:Thing"}
                   for kind in groups}, {"broken_module.py": "1 / 0\n"})
    environment = {**os.environ, "PYTHONPATH": str(site)}

    def run(*words):
        return subprocess.run(
            [sys.executable, "-P", "-W", "error", *words], env=environment,
            capture_output=True, text=True, check=False)

    plain = run("-c", "from pdavis_cv import VideoCapture, data\n"
                "path = data.example_recording()\n"
                "with VideoCapture(path, layout='pdavis', output='aop', method='cf',"
                " cutoff_hz=1) as one: assert one.read()[0], one.last_error")
    assert (plain.returncode, plain.stderr) == (0, "")
    pdavis = ("-m", "pdavis_cv.tools.main")
    whole = run(*pdavis, "--help")
    assert (whole.returncode, whole.stderr) == (0, "")
    assert run(*pdavis, "export", "--help").returncode == 0
    asked = run("-c", "import sys, pdavis_cv\nfrom pdavis_cv.tools.main import main\n"
                "for options in (['--method', 'broken', '--layout', 'pdavis'],\n"
                "                ['--quantities', 'broken']):\n"
                "    print(main(['export', *sys.argv[1:], *options]))\n"
                "pdavis_cv.open_source('broken:')",
                str(example_recording()), "-o", str(tmp_path / "x.npy"))
    assert asked.stdout == "2\n2\n"
    method, quantity, *_, source = asked.stderr.splitlines()
    assert ("method 'broken' of broken_module:Thing cannot be used: division by zero"
            in method)
    assert "quantity 'broken' of broken_module:Thing cannot be used" in quantity
    assert "source 'broken' of broken_module:Thing cannot be used" in source
