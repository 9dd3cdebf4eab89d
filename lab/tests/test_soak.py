"""`python -m lab.soak`: what it follows, and what it calls growth."""
import csv
import json
import sys

import numpy as np
import pytest

from lab import soak

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc")


def sample(stream_s, rss_mb, handles=6, threads=1):
    return soak.Sample(stream_s, 1.0, "fuse", "cf", 10, rss_mb, handles, threads, 1e-6)


@pytest.mark.parametrize(("late", "code"), [
    ({"rss_mb": 109}, 0), ({"rss_mb": 111}, 1), ({"rss_mb": 100, "handles": 7}, 1),
    ({"rss_mb": 100, "threads": 2}, 1)])
def test_growth_counts_from_ten_minutes_on(late, code):
    samples = [sample(60, 50), sample(600, 100), sample(1200, 90), sample(1800, **late)]
    lines, facts = soak._grown(samples, 1)
    assert "from 10 min on: memory +" in lines[-1]
    assert soak._too_much(facts, 10.0) == code


def test_a_turn_of_all_ways_comes_before_growth_counts():
    samples = [sample(600, 50), sample(1200, 100), sample(1800, 105)]
    assert "from 20 min on: memory +5.0 MB" in soak._grown(samples, 2)[0][-1]


def test_it_tells_programs_each_sample_and_what_grew(monkeypatch, capsys):
    samples = [sample(60, 50), sample(600, 100), sample(1200, 101)]
    monkeypatch.setattr(soak, "_stream", lambda *_: iter(samples))
    assert soak.main(["--methods", "cf", "--parts", "fuse", "--json"]) == 0
    told = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [one["rss_mb"] for one in told[:-1]] == [50, 100, 101]
    assert (told[-1]["since_s"], told[-1]["memory_mb"]) == (600, 1)


@pytest.mark.gate
def test_every_way_is_streamed_and_images_come_again(tmp_path, monkeypatch):
    monkeypatch.setattr(soak, "PART_S", 21.0)
    path = tmp_path / "soak.csv"
    assert soak.main(["--minutes", "1.4", "--methods", "cf", "-o", str(path)]) == 0
    rows = list(csv.DictReader(path.read_text().splitlines()))
    assert [row["way"] for row in rows] == list(soak.PARTS)
    assert [float(row["stream_s"]) for row in rows] == [21, 42, 63, 84]
    assert all(int(row["images"]) > 200 for row in rows)
    # One period after the other is the same light.
    assert all(float(row["drift"]) < 1e-3 for row in rows)
    assert len({row["handles"] for row in rows}) == 1


def test_drift_is_the_distance_from_the_second_period(monkeypatch):
    class Image:
        valid = np.ones((2, 2), bool)
        s0 = np.full((2, 2), 2.0)

        def __init__(self, level):
            self.quad = np.full((4, 2, 2), level)

    period = round(soak.PERIOD_US * soak.FPS / 1e6)
    levels = [5.0] * period + [1.0] * period + [1.5]
    assert soak._followed(map(Image, levels)) == (len(levels), 0.25)


@pytest.mark.parametrize("arguments", [["--methods", "no"], ["--hours", "0"]])
def test_mistakes_are_one_line(arguments, capsys):
    assert soak.main(arguments) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
