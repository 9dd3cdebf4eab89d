"""`python -m lab.paper demosaic`: its scores, its scenes, folders of the user."""
import csv

import numpy as np
import pytest

from lab.paper.command import main
from lab.paper.demosaic import mosaic_of, score
from lab.paper.demosaic_scenes import MADE, four_angle_folder, make
from pdavis_cv import Layout, demosaic

cv2 = pytest.importorskip("cv2")


@pytest.mark.gate
@pytest.mark.parametrize("name", MADE)
@pytest.mark.parametrize("seed", [301, 302])
def test_guided_is_nowhere_worse_than_bilinear(name, seed):
    """Seeds that the constants were not tuned on."""
    truth = make(name, (120, 160), seed)
    rng = np.random.default_rng(seed)
    for layout in (Layout.PDAVIS, Layout.SONY):
        clean = mosaic_of(truth, layout)
        noise = rng.standard_normal(clean.shape).astype(np.float32)
        for sigma in (0, clean.mean() / 100):
            mosaic = clean + np.float32(sigma) * noise
            bilinear, guided = (score(demosaic(mosaic, layout, method), truth)
                                for method in ("bilinear", "guided"))
            assert guided[1] > bilinear[1] + 0.5
            assert guided[2] < bilinear[2]
            if not sigma:
                assert guided[0] > bilinear[0]


def test_the_scores_are_what_they_say():
    truth = np.empty((4, 20, 24), np.float32)
    angles = np.deg2rad([0, 45, 90, 135])
    for plane, angle in zip(truth, angles, strict=True):
        plane[:] = 0.5 * (1 + 0.4 * np.cos(2 * (0.5 - angle)))
    found = np.stack([0.55 * (1 + 0.5 * np.cos(2 * (0.6 - angle)))
                      * np.ones((20, 24)) for angle in angles]).astype(np.float32)
    s0_db, dolp_db, aop_deg = score(found, truth)
    assert s0_db == pytest.approx(20, abs=0.01)      # 1.1 for a peak of 1
    assert dolp_db == pytest.approx(20, abs=0.01)    # .5 for .4
    assert aop_deg == pytest.approx(np.rad2deg(0.1), abs=0.01)
    half = found.reshape(4, 10, 2, 12, 2).mean((2, 4))
    assert score(half, truth) == pytest.approx((s0_db, dolp_db, aop_deg), abs=0.01)


@pytest.mark.parametrize("pattern", [
    "cup_{}.png", "cup-{:03d}.png", "cup_I{:03d}.tif", "cup{}deg.bmp", "cup/{}.png"])
def test_a_folder_of_four_angles_is_read_whatever_the_naming(tmp_path, pattern):
    for angle in (0, 45, 90, 135):
        path = tmp_path / pattern.format(angle)
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), np.full((7, 8), angle, np.uint8))
    cv2.imwrite(str(tmp_path / "other_0.png"), np.zeros((4, 4), np.uint8))
    (name, quad), = four_angle_folder(tmp_path).items()
    assert name.startswith("cup")
    assert quad.shape == (4, 6, 8)
    np.testing.assert_allclose(quad[:, 0, 0] * 255, [0, 45, 90, 135], rtol=1e-6)


def test_colour_and_16_bit_images_are_scaled_to_one(tmp_path):
    for angle in (0, 45, 90, 135):
        image = np.zeros((4, 4, 3), np.uint16)
        image[..., 1] = 65535
        cv2.imwrite(str(tmp_path / f"a_{angle}.png"), image)
    quad, = four_angle_folder(tmp_path).values()
    np.testing.assert_array_equal(quad, 1)


@pytest.mark.gate
def test_the_command_writes_table_page_and_picture(tmp_path, capsys):
    for angle in (0, 45, 90, 135):
        cv2.imwrite(str(tmp_path / f"a_{angle}.png"),
                    (make("leaves", (40, 44), 1)[angle // 45] * 255).astype(np.uint8))
    stem = tmp_path / "out"
    assert main(["demosaic", "-o", str(stem),
                 "--scenes", str(tmp_path)]) == 0
    with open(stem.with_suffix(".csv"), newline="") as file:
        rows = list(csv.DictReader(line for line in file if line[0] != "#"))
    assert {row["scene"] for row in rows} == {"a"}
    assert len(rows) == 2 * 3 * 4
    assert "By scene" in stem.with_suffix(".md").read_text()
    assert stem.with_suffix(".png").exists()
    assert "guided" in capsys.readouterr().out


@pytest.mark.parametrize(("arguments", "words"), [
    (["demosaic", "--scenes", "{}"], "no scene of four"),
    (["network", "--scenes", "cup"], "--scenes must be of"),
])
def test_a_users_mistake_is_one_line(tmp_path, capsys, arguments, words):
    arguments = [text.format(tmp_path) for text in arguments]
    assert main([*arguments, "-o", str(tmp_path / "out")]) == 2
    assert words in capsys.readouterr().err


def test_four_unlike_images_are_refused(tmp_path, capsys):
    for angle, side in zip((0, 45, 90, 135), (4, 4, 6, 4), strict=True):
        cv2.imwrite(str(tmp_path / f"a_{angle}.png"), np.zeros((side, 4), np.uint8))
    assert main(["demosaic", "-o", str(tmp_path / "o"),
                 "--scenes", str(tmp_path)]) == 2
    assert "unlike the scene's first" in capsys.readouterr().err
