"""Search a damaged file for packets, in one pass."""
from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import islice

from pdavis_cv.recording.file_reader import FileReader
from pdavis_cv.recording.limits import Budget

_BLOCK = 1 << 18
_MORE = 64
"""Bytes after a block, which show whether a packet begins at its end."""


class Search:
    """Places where packets begin, each byte of the file being looked at once.

    `begins`, given a byte and what follows it in the file, yields places in it, in
    order.
    """

    def __init__(self, reader: FileReader, budget: Budget,
                 begins: Callable[[int, bytes], Iterable[int]]) -> None:
        self._reader, self._budget, self._begins = reader, budget, begins
        self._until = self._looked = 0
        self._found: deque[int] = deque()

    def places(self, at: int, until: int) -> Iterator[int]:
        """Yield the places from `at` to before `until`; `at` is never less again."""
        found, i = self._found, 0
        while found and found[0] < at:
            found.popleft()
        while True:
            for place in islice(found, i, None):
                if place >= until:
                    return
                i += 1
                yield place
            self._until = max(self._until, at)
            if self._until >= until:
                return
            base = self._until
            block = self._reader.read(base, _BLOCK + _MORE)
            self.wasted(len(block))
            self._found += (base + i for i in self._begins(base, block) if i < _BLOCK)
            self._until = base + _BLOCK

    def wasted(self, size: int) -> None:
        """Take bytes that were read in vain."""
        self._looked += size
        self._budget.searched(self._looked)
