"""Finding the layout: every arrangement, from frames and from events."""
import numpy as np
import pytest
from ideal import rotating_polarizer

from pdavis_cv import Layout, recording_from_arrays
from pdavis_cv.calibration.layout import ALL_LAYOUTS, detect_layout

EIGHT = [turned for flipped in (Layout.PDAVIS, Layout.PDAVIS.flip_x())
         for turned in (flipped.rot90(k) for k in range(4))]


def record(layout, rpm, source):
    """Two seconds of a polarizer at 0.3 rad at t = 0, with frames or events only."""
    recording, _ = rotating_polarizer(
        rpm, 2.0, layout=layout, start_angle=0.3, theta=(0.17, 0.15))
    packets = list(recording.packets())
    events = np.concatenate([p.events for p in packets])
    frames = [f for p in packets for f in p.frames]
    return recording_from_arrays(
        events if source == "events" else None, frames if source == "frames" else (),
        sensor_size=(12, 12))


@pytest.mark.parametrize("source", ["frames", "events"])
@pytest.mark.parametrize("layout", EIGHT, ids=str)
@pytest.mark.parametrize("sense", [1, -1])
def test_direction_and_one_angle_give_every_arrangement(layout, source, sense):
    recording = record(layout, sense * 41.0, source)
    angle = 0.3 + sense * 41 / 60 * 2 * np.pi * 0.5
    found = detect_layout(
        recording, direction=sense, known_angle=(500_000, angle % np.pi))
    assert found.layouts == (layout,)
    assert found.cycles == pytest.approx(2 * 2 * 41 / 60, rel=0.05)


@pytest.mark.parametrize("source", ["frames", "events"])
@pytest.mark.parametrize("layout", EIGHT[::3], ids=str)
def test_without_more_knowledge_the_candidates_hold_the_truth(layout, source):
    recording = record(layout, 41.0, source)
    unknown = detect_layout(recording)
    assert len(unknown.layouts) == 8
    assert layout in unknown.layouts
    directed = detect_layout(recording, direction=1)
    assert len(directed.layouts) == 4
    assert layout in directed.layouts
    # All turned by the same constant: the order is known, the zero is not.
    family = detect_layout(recording, family=layout)
    assert family.direction == 1
    assert set(family.layouts) == set(directed.layouts)


@pytest.mark.parametrize("layout", ALL_LAYOUTS[::5], ids=str)
def test_orthogonal_pairs_need_no_knowledge_also_when_they_are_neighbours(layout):
    found = detect_layout(record(layout, 60.78, "events"))
    angles = [layout.angles_deg[i // 2][i % 2] for i in range(4)]
    assert all(abs(angles[i] - angles[j]) == 90 for i, j in found.pairs)


def test_a_fast_rotation_is_followed_by_events():
    found = detect_layout(record(Layout.SONY, -1013.0, "events"), direction=-1)
    assert Layout.SONY in found.layouts
    assert found.cycles == pytest.approx(2 * 2 * 1013 / 60, rel=0.05)


def test_a_scene_without_a_rotating_polarizer_is_refused():
    recording, _ = rotating_polarizer(41.0, 2.0, dolp=0.0)
    with pytest.raises(ValueError, match="must see a rotating polarizer"):
        detect_layout(recording, source="frames")


def test_a_family_that_contradicts_the_direction_is_refused():
    recording = record(Layout.PDAVIS, 41.0, "events")
    with pytest.raises(ValueError, match="contradict"):
        detect_layout(recording, direction=-1, family=Layout.PDAVIS)
