"""CSV of traces, and facts inside pictures and videos."""
import json

import numpy as np
import pytest

from pdavis_cv import PolarFrame, export
from pdavis_cv.analysis import Roi, TraceRecorder
from pdavis_cv.export import read_embedded, write_jaer_csv, write_png, write_traces


@pytest.fixture
def traces():
    rng = np.random.default_rng(0)
    recorder = TraceRecorder([Roi.from_rectangle(0, 0, 6, 6, "fibre"),
                              Roi.from_rectangle(2, 2, 3, 3, "a/b")])
    for k in range(4):
        recorder.add(PolarFrame(rng.uniform(9, 30, (4, 8, 8)), t_us=10**15 + k * 10_000,
                                provenance={"method": "cf", "roi": (0, 0, 8, 8)}))
    return recorder.traces()


def test_pandas_reads_traces_back_to_seven_digits(tmp_path, traces):
    pandas = pytest.importorskip("pandas")
    path = tmp_path / "traces.csv"
    write_traces(path, traces, origin_us=10**15, extra={"force_n": [1, 2, np.nan, 4]})
    table = pandas.read_csv(path)
    assert list(table["roi"].unique()) == ["fibre", "a/b"]
    for r, roi in enumerate(("fibre", "a/b")):
        rows = table[table["roi"] == roi]
        np.testing.assert_array_equal(rows["t_us"], traces.t_us)
        np.testing.assert_array_equal(rows["t_s"], [0, 0.01, 0.02, 0.03])
        for name in ("dolp", "dolp_se"):
            np.testing.assert_allclose(rows[name], traces.table[name][r], rtol=5e-7)
        np.testing.assert_allclose(
            rows["aop_deg"], np.rad2deg(traces.table["aop"][r]), rtol=5e-7)
        assert rows["event_rate_hz"].isna().all()
        assert np.isnan(rows["force_n"].to_numpy()[2])
    assert json.loads((tmp_path / "traces.csv.json").read_text()) == {
        "method": "cf", "roi": [0, 0, 8, 8]}
    with pytest.raises(ValueError, match=r"x must be \(2, 4\) or \(4,\)"):
        write_traces(path, traces, extra={"x": [1, 2]})


def test_decimal_commas_are_separated_by_semicolons(tmp_path, traces):
    pandas = pytest.importorskip("pandas")
    path = tmp_path / "traces.csv"
    write_traces(path, traces, origin_us=10**15, decimal=",")
    table = pandas.read_csv(path, sep=";", decimal=",")
    np.testing.assert_allclose(table["t_s"][:4], [0, 0.01, 0.02, 0.03])
    np.testing.assert_allclose(table["dolp"][:4], traces.table["dolp"][0], rtol=5e-7)
    assert "." not in path.read_text()


def test_jaer_files_have_jaers_header_and_one_region_each(tmp_path, traces):
    pandas = pytest.importorskip("pandas")
    paths = write_jaer_csv(tmp_path / "roi.csv", traces, origin_us=10**15)
    assert [p.name for p in paths] == ["roi-fibre.csv", "roi-a_b.csv"]
    header = paths[0].read_text().splitlines()[0]
    assert header == ("lastTimestamp(s),ROINumPixels,f0,f45,f90,f135,AoP(deg),"
                      "AoPStd(deg),DoLP,DoLPStd")
    table = pandas.read_csv(paths[0], converters={"f45": float})    # to the bit
    np.testing.assert_array_equal(table["f45"], traces.table["i45"][0])
    np.testing.assert_array_equal(table["ROINumPixels"], 36)


FACTS = {"method": "kalman", "note": "Größe", "list": [1, 2.5, None]}


@pytest.mark.parametrize("suffix", [".webm", ".mp4", ".mkv", ".avi"])
def test_facts_travel_inside_videos_that_still_play(tmp_path, suffix):
    cv2 = pytest.importorskip("cv2")
    path = tmp_path / f"a{suffix}"
    pictures = [np.full((33, 51, 3), 20 * k, np.uint8) for k in range(8)]
    with export.VideoFile(path, 25, FACTS) as video:
        for picture in pictures:
            video.add(picture)
    assert read_embedded(path) == FACTS
    reader = cv2.VideoCapture(str(path))
    shown = []
    while (got := reader.read())[0]:
        shown.append(got[1])
    assert reader.get(cv2.CAP_PROP_FPS) == 25
    reader.release()
    assert len(shown) == 8
    assert shown[0].shape == (34, 52, 3)  # an odd side is padded, not cut
    assert abs(float(shown[5].mean()) - 100) < 4


def test_facts_travel_inside_a_png(tmp_path):
    cv2 = pytest.importorskip("cv2")
    picture = np.random.default_rng(2).integers(0, 255, (9, 11, 3), np.uint8)
    write_png(tmp_path / "a.png", picture, FACTS)
    assert read_embedded(tmp_path / "a.png") == json.loads(json.dumps(FACTS))
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.png")), picture)
    write_png(tmp_path / "b.png", picture)
    assert read_embedded(tmp_path / "b.png") is None
