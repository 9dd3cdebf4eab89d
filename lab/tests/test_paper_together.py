"""Experiments that are done are kept; what changed is made again."""
import dataclasses
import os

import pytest

from lab.paper import together
from lab.paper.page import write_rows
from lab.paper.run import Row, Settings

CALLS = []


def a_row(seed):
    numbers = {item.name: 0.5 for item in dataclasses.fields(Row)}
    return Row(**{**numbers, "scene": "fan", "region": "left", "camera": "nominal",
                  "seed": seed, "method": "kalman", "dolp_roi": float("nan")})


def make(name, stem, settings):
    CALLS.append(name)
    rows = [a_row(seed) for seed in settings.seeds]
    write_rows(stem, rows, {})
    return "", rows


@pytest.fixture
def stems(tmp_path, monkeypatch):
    monkeypatch.setattr(together, "usable_cores", lambda: 1)    # in this process
    CALLS.clear()
    return {name: tmp_path / f"all-{name}" for name in ("one", "two")}


def same(a, b):
    return [repr(row) for row in a] == [repr(row) for row in b]     # of NaN too


def test_what_is_done_is_kept_until_something_changes(stems, capsys):
    settings = Settings(seeds=(1, 2))
    first = together.made(stems, settings, make)
    again = together.made(stems, settings, make)
    assert CALLS == ["one", "two"]
    assert list(again) == ["one", "two"]
    assert all(same(first[name], again[name]) for name in stems)
    assert "two: kept, nothing has changed" in capsys.readouterr().out
    together.made(stems, Settings(seeds=(3,)), make)
    assert CALLS == ["one", "two"] * 2


@pytest.mark.parametrize("harm", [
    lambda stem: os.truncate(f"{stem}.csv", 10), lambda stem: os.remove(f"{stem}.csv"),
    lambda stem: os.truncate(f"{stem}.done.json", 10)])
def test_half_of_it_is_made_again(stems, harm):
    together.made(stems, Settings(), make)
    harm(stems["one"])
    together.made(stems, Settings(), make)
    assert CALLS == ["one", "two", "one"]


def test_other_code_is_no_reason_to_keep_it(stems, monkeypatch):
    together.made(stems, Settings(), make)
    monkeypatch.setattr(together.pdavis_cv, "__version__", "99")
    together.made(stems, Settings(), make)
    assert CALLS == ["one", "two"] * 2


def test_an_error_of_one_is_told_and_the_others_are_kept(stems):
    def fails(name, stem, settings):
        if name == "two":
            raise ValueError("no")
        return make(name, stem, settings)

    with pytest.raises(ValueError, match="no"):
        together.made(stems, Settings(), fails)
    together.made(stems, Settings(), make)
    assert CALLS == ["one", "two"]
