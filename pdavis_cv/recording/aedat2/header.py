"""Parse the text header of AEDAT-2.0 files, in the variants of several programs."""
from __future__ import annotations

import re
from dataclasses import dataclass, field

from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.file_reader import FileReader

SOURCE = "SourceFacts"
"""Line of this library's writer that says what is known of the source."""
MAX_HEADER = 4 << 20
USUAL_HEADER = 1 << 16
CHIP_SIZES = {"sbret": (180, 240), "dvs128": (128, 128), "tmpdiff128": (128, 128),
              "davis346": (260, 346), "davis240": (180, 240), "davis640": (480, 640),
              "davis208": (192, 208), "davis128": (128, 128)}
"""(height, width) by the beginning of the chip class's name; SBret10, 20 and 21 are
jAER's first names of the DAVIS240.  Of names of one size the last is written."""
DVS128 = ("dvs128", "tmpdiff128")
"""Beginnings of the names of chips whose addresses are those of a DVS128."""

_CHIP = re.compile(r"AEChip\s*[:=]\s*([\w.]+)", re.IGNORECASE)
_MILLISECONDS = r"\s*:\s*System\.currentTimeMillis\(\)\s*(\d+)"
_DATA_START = re.compile("DataStartTime" + _MILLISECONDS)
_ORIGIN = re.compile(r"TimeOrigin: (-?\d{1,18}) us")
_CREATION = re.compile("Creation time" + _MILLISECONDS)
# Three styles: XML of all chips, plain entries of this chip, entries without chip.
_ENTRY = re.compile(
    r'<entry\s+key="(?:(\w+)\.)?((?:APS|AddressedIPotCF|IMU|DVS)\.[\w.]+)"\s+'
    r'value="([^"]*)"')
_END = re.compile(r"\s*end of ascii header\s*", re.IGNORECASE)
_ALIASES = {"davis346mini": "davis346blue"}


@dataclass(slots=True)
class Header:
    """The content of a header.

    The words begin at the byte `data_start`.  `chip` is the simple name of the chip
    class, `preferences` are those of this chip, without its name, `facts` lines of the
    form ``name: value``.  `start_ms` and `creation_ms` are the Unix times in
    milliseconds of the first event and of the file, `origin_us` what this library's
    writer subtracted from all times.
    """

    data_start: int
    lines: int = 0
    chip: str | None = None
    preferences: dict[str, str] = field(default_factory=dict)
    facts: dict[str, str] = field(default_factory=dict)
    start_ms: int | None = None
    creation_ms: int | None = None
    origin_us: int = 0

    @property
    def size(self) -> tuple[int, int] | None:
        """Sensor (height, width) of the chip, None if the chip is unknown."""
        # The INI's aedat4to2 spells it DAVI346.
        name = (self.chip or "").lower().replace("davi3", "davis3")
        return next((size for start, size in CHIP_SIZES.items()
                     if name.startswith(start)), None)

    def number(self, key: str) -> int | None:
        """Return a preference as an integer, None if it is missing or not a number."""
        try:
            return int(float(self.preferences[key]))
        except (KeyError, ValueError, OverflowError):
            return None

    @property
    def global_shutter(self) -> bool | None:
        """Whether the shutter is global, None if the header does not say so."""
        text = self.preferences.get("APS.GlobalShutter", "").strip().lower()
        return {"true": True, "false": False}.get(text)


def read_header(reader: FileReader) -> Header:
    """Return the header, of at most 4 MiB, of a file that begins ``#!AER-DAT2``."""
    at = 0
    for most in (USUAL_HEADER, MAX_HEADER):
        data = reader.read(0, most)
        at, lines = _lines(data)
        if len(data) < most or at <= most - 4096:
            return _understand(Header(at, len(lines)), lines)
    raise RecordingError(
        f"{reader.path}: byte {at}: the header does not end within {MAX_HEADER} bytes")


def _lines(data: bytes) -> tuple[int, list[str]]:
    """Return the byte at which the header's lines end, and the lines."""
    at, lines = 0, []
    while data[at:at + 1] == b"#":
        end = data.find(b"\n", at)
        if end < 0:
            # A truncated header, or a first word that looks like a comment.
            if not _is_binary(data[at:at + 64]):
                at = len(data)
            break
        line = data[at + 1:end]
        if _is_binary(line):
            break
        at = end + 1
        text = line.decode("latin-1").rstrip("\r")
        lines.append(text)
        if _END.fullmatch(text):
            break
    return at, lines


def _is_binary(line: bytes) -> bool:
    """Return whether a line beginning with '#' is a data word: it has control bytes."""
    return any(byte < 32 and byte not in (9, 13) for byte in line)


def _understand(header: Header, lines: list[str]) -> Header:
    text = "\n".join(lines)
    if found := _CHIP.search(text):
        header.chip = found[1].rsplit(".", 1)[-1]
    for name, pattern in (("start_ms", _DATA_START), ("creation_ms", _CREATION)):
        if found := pattern.search(text):
            setattr(header, name, int(found[1][:18]))
    if found := _ORIGIN.search(text):
        header.origin_us = int(found[1])
    chip = (header.chip or "").lower()
    names = {chip, _ALIASES.get(chip, chip)}
    for prefix, key, value in _ENTRY.findall(text):
        if not prefix or not chip or prefix.lower() in names:
            header.preferences.setdefault(key, value)
    for line in lines:
        name, colon, value = line.partition(":")
        if colon and "<" not in line and len(header.facts) < 100:
            header.facts.setdefault(name.strip(), value.strip())
    return header


def bias_currents(header: Header) -> dict[str, float]:
    """Return bias currents in ampere, by name.

    I = 389 nA * 8 ** (b - 5) * fine / 256 with b = 7 - coarse: the XML holds the
    inverted coarse code.
    """
    currents = {}
    for key in header.preferences:
        _, _, rest = key.partition("AddressedIPotCF.")
        name, dot, kind = rest.partition(".")
        if not dot or kind != "BitValueCoarse":
            continue
        coarse = header.number(key)
        fine = header.number(f"AddressedIPotCF.{name}.BitValueFine")
        if coarse is not None and fine is not None and (
                0 <= coarse <= 7 and 0 <= fine <= 255):
            currents[name] = 389e-9 * 8.0 ** (2 - coarse) * fine / 256
    return currents
