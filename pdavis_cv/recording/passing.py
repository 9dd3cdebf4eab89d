"""A recording whose packets pass through a function."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

from pdavis_cv.recording.base import Packet, Problem, Recording, RecordingInfo
from pdavis_cv.recording.members import Member

__all__ = ["passing"]


class _Passing(Recording):
    def __init__(self, recording: Recording,
                 through: Callable[[Iterable[Packet]], Iterable[Packet]]) -> None:
        self._recording, self._through = recording, through

    @property
    def info(self) -> RecordingInfo:
        return self._recording.info

    @property
    def problems(self) -> Sequence[Problem]:
        return self._recording.problems

    def packets(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> Iterator[Packet]:
        yield from self._through(self._recording.packets(start_us, stop_us))

    @property
    def members(self) -> tuple[Member, ...]:
        return self._recording.members

    def close(self) -> None:
        self._recording.close()


def passing(recording: Recording,
            through: Callable[[Iterable[Packet]], Iterable[Packet]]) -> Recording:
    """Return a recording whose packets pass through a function, e.g. for progress.

    Parameters
    ----------
    recording : Recording
    through : callable
        Takes an iterable of packets and returns one.

    Returns
    -------
    Recording
    """
    return _Passing(recording, through)
