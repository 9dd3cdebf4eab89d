r"""The AEDAT-4 container: header, packets and index, and recovery of damaged files.

Written from the published AEDAT-4 schema: "#!AER-DAT4.0\r\n", a size-prefixed
FlatBuffer IOHE, packets of (int32 stream, int32 size, payload), a table FTAB.
"""
from __future__ import annotations

import contextlib
import itertools
import struct
from _thread import get_ident  # threading is slow to import
from collections.abc import Iterator
from functools import lru_cache, partial
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from lz4.frame import create_decompression_context, decompress_chunk
from numpy.typing import NDArray

from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.aedat4 import samples
from pdavis_cv.recording.aedat4.flatbuffer import PayloadError, Table
from pdavis_cv.recording.file_reader import FileReader
from pdavis_cv.recording.files import ProblemLog, clock_text
from pdavis_cv.recording.limits import Budget
from pdavis_cv.recording.search import Search
from pdavis_cv.recording.timeline import NEVER, SEGMENT_US

MAGIC = b"#!AER-DAT4.0\r\n"
COMPRESSIONS = ("none", "LZ4", "LZ4_HIGH", "ZSTD", "ZSTD_HIGH")
MAX_PAYLOAD = 128 << 20
"""Largest size of a decompressed payload, bytes; a writer's packet holds 10 ms."""
MAX_HEADER = 16 << 20
_LZ4_MAGIC = b"\x04\x22\x4d\x18"
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_PACKET = struct.Struct("<ii")
_NEAR, _TRIES = 1 << 16, 8
"""A packet that is not at its position in the index is searched within this number of
bytes, among this number of candidates with its stream and size."""
_BLOCK = 1 << 20
"""Bytes of an index that are unpacked to know it: a block of LZ4 is seldom larger."""
_HEAD, _LEAST = 24, 12
"""Bytes that identify a packet: its header and the beginning of its payload; those of
a payload are its size, the place of its table, and the kind of it."""


class Entry(NamedTuple):
    """The location of a packet; samples and times are None without an index."""

    stream: int
    offset: int
    size: int
    samples: int | None = None
    start_us: int | None = None
    stop_us: int | None = None


class Stream(NamedTuple):
    """A stream as described in the header."""

    number: int
    kind: str
    attributes: dict[str, str]
    entries: list[Entry]

    @property
    def source(self) -> str:
        """Camera and serial number as written in the file."""
        return self.attributes.get("source", "")


class Aedat4File:
    """Header, streams and packets of one file, whose reader the caller closes.

    Findings of damage go to the log; the budget is by default one of the file's own.
    `compression` is one of ``COMPRESSIONS``; `indexed` tells whether the file has a
    usable index; `index` has the entries of a stream, int64 (N, 5), if it has the times
    of all packets, in order.  A header that cannot be read is a RecordingError.
    """

    def __init__(self, reader: FileReader, log: ProblemLog,
                 budget: Budget | None = None) -> None:
        self.reader, self.log = reader, log
        self.budget = budget or Budget(reader.path)
        # Of packets that are not where the index says.
        self._shift = self._sought = 0
        self._found: dict[int, int | None] = {}
        self._read_header()
        self.indexed, self.index = False, dict[int, NDArray[np.int64]]()
        self.indexed = self._read_index()
        if not self.indexed:
            for entry in self._walk():
                self.streams[entry.stream].entries.append(entry)

    def _fail(self, offset: int, message: str) -> RecordingError:
        return RecordingError(f"{self.reader.path}: byte {offset}: {message}")

    def _read_header(self) -> None:
        first = self.reader.read(0, len(MAGIC) + 4)
        if first[:len(MAGIC)] != MAGIC:
            raise self._fail(0, f"not an AEDAT-4 file, first bytes {first[:8]!r}")
        if len(first) < len(MAGIC) + 4:
            raise self._fail(len(first), "the file ends inside the header")
        size = int.from_bytes(first[-4:], "little")
        if size > MAX_HEADER:
            raise self._fail(len(MAGIC), f"the header cannot be {size} bytes long")
        data = self.reader.read(len(MAGIC), size + 4)
        if len(data) < size + 4:
            raise self._fail(self.reader.size, "the file ends inside the header")
        self.data_start = len(MAGIC) + 4 + size
        try:
            self.compression, self.table_position, self.streams = parsed_header(data)
        except ValueError as error:
            raise self._fail(len(MAGIC), str(error)) from error
        if not self.streams:
            raise self._fail(len(MAGIC), "the header names no stream")

    # Index ---------------------------------------------------------------------

    def _read_index(self) -> bool:
        at = self.table_position
        if at < 0:
            return False  # the writer did not close the file, or keeps no index
        if not self.data_start <= at < self.reader.size:
            self.log.damage(
                ("index", at), f"byte {at}: the index should be here, but the file "
                f"ends at byte {self.reader.size}; packets are searched instead",
                offset=at)
            return False
        try:
            return self._take_index(self.reader.read(at, MAX_PAYLOAD))
        except PayloadError as error:
            self.log.damage(
                ("index", at), f"byte {at}: the index cannot be read ({error}); "
                "packets are searched instead", offset=at)
            for stream in self.streams.values():
                stream.entries.clear()
            return False

    def _take_index(self, payload: bytes) -> bool:
        """Use an index; return False if it lacks counts and times."""
        if payload[8:12] != b"FTAB":  # DV compresses it, jAER does not
            payload = decompressed(payload, self.compression, self.budget)
        rows = Table(payload, b"FTAB").rows(0, np.int64, 5)
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        if len(rows) and not rows[:, 2:].any():
            return False  # some writers fill in the places only
        number, size = rows[:, 1] & 0xFFFFFFFF, rows[:, 1] >> 32
        ends = self.data_start + np.cumsum(8 + size)
        # Offsets are those of the payload in DV, of the packet's header in jAER.
        header = 8 * (rows[:1, 0].tolist() == [self.data_start])
        if not np.array_equal(rows[:, 0] + header, ends - size) or (
                [self.data_start, *ends][-1] != self.table_position):
            raise PayloadError("its entries do not add up to the file" if len(rows) else
                               "it is empty, but the file holds packets")
        if not self.streams.keys() >= set(number.tolist()):
            raise PayloadError("it names a stream that the header does not")
        if np.any(rows[:, 2] < 0):
            raise PayloadError("it holds a negative number of elements")
        rows[:, 0], rows[:, 1] = ends - size, size
        for stream in self.streams.values():
            own = rows[number == stream.number]
            stream.entries.extend(map(Entry._make, zip(
                itertools.repeat(stream.number), *own.T.tolist(), strict=False)))
            times = np.concatenate(([NEVER], own[:, 3:].ravel(), [-NEVER]))
            if np.all(times[1:] >= times[:-1]):
                self.index[stream.number] = own
        return True

    # Packets -------------------------------------------------------------------

    def _walk(self) -> Iterator[Entry]:
        """Find packets by their headers, even if damage has moved or hidden them."""
        at, limit = self.data_start, self.reader.size
        # Damage that moved packets has also moved the index.
        if at <= self.table_position < limit and self._is_index(self.table_position):
            limit = self.table_position
        search = Search(self.reader, self.budget, partial(self._begins, limit))
        entry = self._plausible(at, limit)
        while at < limit:
            if entry is None:
                if self._is_index(at):
                    return
                found = next(search.places(at + 1, limit), None)
                self.log.damage(
                    at, f"byte {at}: no whole packet is here, reading goes on at byte "
                    f"{limit if found is None else found}", offset=at)
                if found is None:
                    return
                at, entry = found, self._plausible(found, limit)
                continue
            after = entry.offset + entry.size
            # Data resemble the beginning of a packet by chance once in 10**19 bytes, so
            # if one begins inside another, the other lost bytes or its size is wrong.
            inside = next(search.places(at + 1, after), None)
            if inside is not None and not self._headless(entry, after - inside):
                self.log.damage(
                    at, f"byte {at}: a packet that should end at byte {after} "
                    f"ends at {inside}", offset=at)
                entry = entry._replace(size=max(inside - entry.offset, 0))
            after = after if inside is None else inside
            following = self._plausible(after, limit)
            yield entry
            at, entry = after, following

    def _plausible(self, at: int, limit: int, head: bytes | None = None
                   ) -> Entry | None:
        """Return the packet at a byte, if its header and end are plausible."""
        head = self.reader.read(at, _HEAD) if head is None else head
        if len(head) < _PACKET.size:
            return None
        stream, size = _PACKET.unpack_from(head)
        if stream not in self.streams or not 0 < size <= limit - at - 8:
            return None
        payload = head[8:]
        if self.compression.startswith("LZ4"):
            right = payload[:4] == _LZ4_MAGIC
        elif self.compression.startswith("ZSTD"):
            right = payload[:4] == _ZSTD_MAGIC
        else:
            right = (int.from_bytes(payload[:4], "little") == size - 4
                     and payload[8:12] == self.streams[stream].kind.encode())
        return Entry(stream, at + 8, size) if right else None

    def _headless(self, entry: Entry, overlap: int) -> bool:
        """Return whether the packet after this one, not it, lost its first bytes."""
        times = None    # the last bytes of events can be the number of a stream
        if overlap < _PACKET.size and self.streams[entry.stream].kind == "EVTS":
            with contextlib.suppress(PayloadError):
                times = samples.span("EVTS", self.table(entry))
        return times is not None and 0 <= times[1] - times[0] <= SEGMENT_US

    def _is_index(self, at: int) -> bool:
        head = self.reader.read(at, _HEAD)
        if head[8:12] == b"FTAB":
            return True
        if head[:4] not in (_LZ4_MAGIC, _ZSTD_MAGIC):
            return False
        with contextlib.suppress(PayloadError):
            block = self.reader.read(at, _BLOCK)
            return _unpacked(block, self.compression, _LEAST)[8:] == b"FTAB"
        return False

    def _begins(self, limit: int, base: int, block: bytes) -> Iterator[int]:
        """Yield where plausible packets begin in the bytes from base on."""
        if self.compression == "none":
            marks = {stream.kind.encode() for stream in self.streams.values()}
            before = 16  # stream, size, prefix, root, identifier
        else:
            lz4_used = self.compression.startswith("LZ4")
            marks, before = {_LZ4_MAGIC if lz4_used else _ZSTD_MAGIC}, 8
        for i in sorted(i for mark in marks for i in _find_all(block, mark)):
            at = i - before
            if at >= 0 and self._plausible(base + at, limit, block[at:at + _HEAD]):
                yield at

    def table(self, entry: Entry) -> Table:
        """Return the FlatBuffer of a packet.

        PayloadError if it cannot be decompressed, or has another type than its stream.
        """
        raw = self.reader.read(entry.offset - 8, entry.size + 8)
        if len(raw) < entry.size + 8:
            raise PayloadError("the file ends inside it")
        if self.indexed and _PACKET.unpack_from(raw) != (entry.stream, entry.size):
            return self._moved(entry)
        return self._decoded(entry.stream, raw)

    def _decoded(self, stream: int, raw: bytes) -> Table:
        return Table(decompressed(memoryview(raw)[8:], self.compression, self.budget),
                     self.streams[stream].kind.encode())

    def _moved(self, entry: Entry) -> Table:
        """Search for a packet near its position in the index.

        Damage that removes bytes at one position and adds them at another moves the
        packets in between.
        """
        wanted = entry.offset - 8
        for at in self._places(entry, wanted):
            try:
                table = self._decoded(
                    entry.stream, self.reader.read(at, entry.size + 8))
                times = samples.span(self.streams[entry.stream].kind, table)
            except PayloadError:
                continue
            if times == (entry.start_us, entry.stop_us):
                self.log.damage(
                    wanted, f"byte {wanted}: the packet that the index places here is "
                    f"at byte {at}", offset=wanted)
                self._shift, self._found[wanted] = at - wanted, at
                return table
        self._found.setdefault(wanted, None)
        raise PayloadError("its header is not what the index says")

    def _places(self, entry: Entry, wanted: int) -> Iterator[int]:
        """Yield where a packet may be: where it was, as far away as the last, or near.

        Once too much has been searched, what has not moved alike is given up.
        """
        if (known := self._found.get(wanted)) is not None:
            yield known
        header = _PACKET.pack(entry.stream, entry.size)
        if self.reader.read(wanted + self._shift, _PACKET.size) == header:
            yield wanted + self._shift
        if wanted in self._found or self._sought > _NEAR + (
                self.budget.limits.work_per_byte * self.reader.size):
            return
        begin = max(0, wanted - _NEAR)      # the header may have lost bytes
        block = self.reader.read(begin, wanted - begin + _NEAR + entry.size)
        self._sought += len(block)
        found = [begin + i for i in _find_all(block, header)]
        yield from sorted(found, key=lambda at: abs(at - wanted))[:_TRIES]

    def lost(self, entry: Entry, error: Exception) -> None:
        """Log that a packet could not be read."""
        self.log.damage(
            entry.offset, f"byte {entry.offset - 8}: packet of stream {entry.stream} "
            f"{clock_text(entry.start_us, entry.stop_us)} cannot be read ({error})",
            offset=entry.offset - 8, start_us=entry.start_us, stop_us=entry.stop_us)


def parsed_header(data: bytes) -> tuple[str, int, dict[int, Stream]]:
    """Return compression, position of the index (-1 = none) and streams of a header.

    The header is a size-prefixed FlatBuffer IOHE; ValueError if it is damaged, whose
    message describes the damage.
    """
    try:
        table = Table(data, b"IOHE")
        [code], [position] = table.fields(0, np.int32), table.fields(1, np.int64)
        text = table.text(2)
    except PayloadError as error:
        raise ValueError(f"the header is damaged: {error}") from error
    if not 0 <= code < len(COMPRESSIONS):
        raise ValueError(f"unknown compression {code}")
    try:
        streams = {s.number: s for s in _streams(text)}
    except (ElementTree.ParseError, ValueError) as error:
        raise ValueError(f"the header's XML is damaged: {error}") from error
    return COMPRESSIONS[code], position or -1, streams


def decompressed(payload: bytes | memoryview, compression: str, budget: Budget
                 ) -> bytes:
    """Return the FlatBuffer of a packet in one of ``COMPRESSIONS``.

    PayloadError if it cannot be decompressed, RecordingError if it becomes larger than
    the budget allows.
    """
    if compression == "none":
        return bytes(payload)
    most = max(budget.most(len(payload)), _LEAST)   # which says what it becomes
    data = _unpacked(payload, compression, most)
    if len(data) >= most:
        budget.piece(_declared(data), "a packet", len(payload))
    return data


def _unpacked(payload: bytes | memoryview, compression: str, most: int) -> bytes:
    return (_unpack_zstd(bytes(payload), most) if compression.startswith("ZSTD") else
            _unpack_lz4(payload, most))


def _unpack_lz4(payload: bytes | memoryview, most: int) -> bytes:
    # LZ4FrameDecompressor copies a memoryview.
    context = create_decompression_context()
    data: bytes
    try:
        data, used, ended = decompress_chunk(
            context, payload, max_length=min(max(4 * len(payload), 1 << 16), most))
        if ended:
            return data
        size = min(_declared(data), most)
        if size > len(data):
            data += decompress_chunk(
                context, payload[used:], max_length=size - len(data))[0]
    except (RuntimeError, EOFError, MemoryError) as error:
        raise PayloadError(f"LZ4: {error}") from error
    if len(data) < size:
        raise PayloadError(f"LZ4: {len(data)} of {size} bytes")
    return data


def _unpack_zstd(payload: bytes, most: int) -> bytes:
    try:
        import zstandard
    except ImportError:
        raise RecordingError(
            "this file is compressed with zstd: pip install zstandard"
        ) from None
    unpack = _zstd_of(get_ident())
    try:
        if zstandard.get_frame_parameters(payload).content_size <= most:
            data: bytes = unpack.decompress(payload)
            size = _declared(data)
        else:       # unknown, or too much
            with unpack.stream_reader(payload) as stream:
                data = stream.read(4)
                size = min(_declared(data), most)
                data += stream.read(size - 4)
    except zstandard.ZstdError as error:
        raise PayloadError(f"zstd: {error}") from error
    if len(data) < size:
        raise PayloadError(f"zstd: {len(data)} of {size} bytes")
    return data[:size]


@lru_cache(16)
def _zstd_of(thread: int) -> Any:
    """Return a decompressor for a thread; making one takes longer than a packet."""
    import zstandard
    return zstandard.ZstdDecompressor(max_window_size=MAX_PAYLOAD)


def _declared(data: bytes) -> int:
    """Return the size of a buffer according to its size prefix, which is included."""
    size = int.from_bytes(data[:4], "little") + 4
    if len(data) < 4 or not _LEAST <= size <= MAX_PAYLOAD:
        raise PayloadError(f"a packet cannot hold {size} bytes")
    return size


def _find_all(block: bytes, mark: bytes) -> Iterator[int]:
    i = block.find(mark)
    while i >= 0:
        yield i
        i = block.find(mark, i + 1)


def _streams(text: str) -> Iterator[Stream]:
    """Yield the streams: the nodes, at any depth, whose names are numbers."""
    for node in ElementTree.fromstring(text.rstrip("\0")).iter("node"):
        name = node.get("name", "")
        if name.isdecimal():
            attributes = {one.get("key", ""): one.text or ""
                          for one in node.iter("attr")}
            kind = attributes.get("typeIdentifier", "")
            if len(kind) == 4 and kind.isascii():
                yield Stream(int(name), kind, attributes, [])
