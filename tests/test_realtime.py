"""Fusion in real time: what is done while data are waited for."""
import pytest
from streams import METHODS, assert_same, turning_polarizer

from pdavis_cv import Layout, fuse
from pdavis_cv.fusion.online_learning import OnlineLearning
from pdavis_cv.live.replay import PIECE_US, ReplaySource
from pdavis_cv.reconstruct.frames import FrameHold

OPTIONS = {"layout": Layout.PDAVIS, "nominal_thresholds": (0.16, 0.18), "fps": 60,
           "causal": True}
PATIENCE_S = 60     # longer than a loaded machine takes; nothing is asserted of time


@pytest.fixture(scope="module")
def recording():
    return turning_polarizer()


@pytest.mark.filterwarnings("ignore::UserWarning")     # long windows of a network
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_frames_that_are_used_while_waiting_change_no_bit(
        recording, method, monkeypatch):
    options = {**OPTIONS, **method}
    expected = list(fuse(recording, **options))
    source = ReplaySource(recording, "test", speed=0.0)
    source.realtime = True
    started = OnlineLearning._started

    def at_once(online):    # as in a file, an estimate is there when it is due
        future = started(online)
        future.result(PATIENCE_S)
        return future

    monkeypatch.setattr(OnlineLearning, "_started", at_once)
    assert_same(list(fuse(source, **options)), expected)


def longest_delay_us(recording, realtime):
    """Return for how long frames that were read waited for images, of which 2 come per
    second, in stream time.
    """
    read, delays = [], []

    class Watched(ReplaySource):
        def packets(self):
            for packet in super().packets():
                read.append(packet.stop_us or 0)
                yield packet

    class Noting(FrameHold):
        def add_frame(self, frame):
            delays.append(max(read) - frame.available_us)
            super().add_frame(frame)

    source = Watched(recording, "test", speed=0.0)
    source.realtime = realtime
    list(fuse(source, **{**OPTIONS, "fps": 2}, method=Noting))
    assert len(delays) >= 10
    return max(delays)


def test_in_real_time_a_frame_is_used_while_an_image_is_waited_for(recording):
    assert longest_delay_us(recording, realtime=True) <= 2 * PIECE_US
    assert longest_delay_us(recording, realtime=False) > 100_000
