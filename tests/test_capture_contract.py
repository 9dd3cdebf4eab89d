"""VideoCapture and cv2.VideoCapture answer alike, row by row."""
import ast
import functools
import inspect
from pathlib import Path

import cv2
import numpy as np
import pytest
from cv2_manners import ROWS, VERSION, kit, outcome
from images import encoded

from pdavis_cv import Layout, VideoCapture

N = 30


@pytest.fixture(scope="module")
def theirs(tmp_path_factory):
    """The real class on an MJPG file whose image k has the value 8 k."""
    path = tmp_path_factory.mktemp("cv2") / "clip.avi"
    writer = cv2.VideoWriter(
        str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (64, 48))
    assert writer.isOpened()
    for k in range(N):
        writer.write(np.full((48, 64, 3), 8 * k, np.uint8))
    writer.release()
    return kit(cv2.VideoCapture, path, path.with_name("missing.avi"), (48, 64, 3),
               lambda image: round(float(image.mean()) / 8))


def ours(path, missing, shape, **keywords):
    ctor = functools.partial(VideoCapture, **keywords)
    ctor.waitAny = VideoCapture.waitAny
    with ctor(path) as cap:
        known = [image.tobytes() for image in cap]
    assert len(set(known)) == N
    return kit(ctor, path, missing, shape, lambda image: known.index(image.tobytes()))


@pytest.fixture(scope="module")
def on_recording(data_dir):
    """Ours on 1.2 s of a real recording."""
    path = data_dir / "davis346.aedat4"
    return ours(path, path.with_name("missing.aedat4"), (96, 128, 3), fps=25,
                stop_us=1589163147365215 + N * 40_000, layout=Layout.PDAVIS,
                roi=(101, 80, 128, 96), method="cf")


@pytest.fixture(scope="module")
def on_mosaic(tmp_path_factory):
    """Ours on a lossless 16-bit mosaic video."""
    path = encoded(
        tmp_path_factory.mktemp("mosaic") / "clip.mkv",
        [np.full((48, 64), 2000 * k, np.uint16) for k in range(N)], "ffv1", "gray16le")
    return ours(path, path.with_name("missing.mkv"), (48, 64, 3), layout=Layout.SONY)


@pytest.mark.parametrize("row", [row for row in ROWS if row.since <= VERSION],
                         ids=lambda row: row.claim)
def test_cv2_does_what_the_table_says(row, theirs):
    assert outcome(row.probe, theirs) == row.expected


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.claim)
def test_a_recording_is_read_as_cv2_reads_a_video(row, on_recording):
    expected = row.ours if row.reason else row.expected
    assert outcome(row.probe, on_recording) == expected


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.claim)
def test_a_mosaic_video_is_read_as_cv2_reads_a_video(row, on_mosaic):
    expected = row.ours if row.reason else row.expected
    assert outcome(row.probe, on_mosaic) == expected


def test_every_row_has_its_own_claim():
    claims = [row.claim for row in ROWS]
    assert len(claims) == len(set(claims))


@pytest.mark.skipif(VERSION < (4, 8), reason="this OpenCV has no stub")
def test_signatures_are_those_of_cv2():
    """Every call that cv2's stub allows binds to ours, under the same names."""
    stub = ast.parse(Path(cv2.__file__).with_name("__init__.pyi").read_text())
    theirs = next(node for node in stub.body
                  if isinstance(node, ast.ClassDef) and node.name == "VideoCapture")
    functions = [node for node in theirs.body if isinstance(node, ast.FunctionDef)]
    assert {f.name for f in functions} >= {"read", "retrieve", "grab", "set", "waitAny"}
    for function in functions:
        mine = inspect.signature(getattr(VideoCapture, function.name))
        arguments = [a.arg for a in function.args.args]
        required = len(arguments) - len(function.args.defaults)
        if arguments[1:2] in (["index"], ["source"]):
            # The other overloads' first argument, here by position or keyword.
            mine.bind(*arguments)
            continue
        for n in range(required, len(arguments) + 1):
            mine.bind(*arguments[:n])
            named = [name for name in arguments[1:n]]
            start = arguments[:1] if function.name != "waitAny" else []
            mine.bind(*start, **dict.fromkeys(
                named if start else arguments[:n]))
