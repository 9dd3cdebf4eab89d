"""What a text of events says of itself, and what its numbers say: columns, unit, size.

Programs write the same list in many forms: with names of the columns, with comments,
with a first line that is the sensor's size, with further columns, with times in seconds
or integers.
"""
from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.options import MAX_SIDE

UNITS = ("us", "s", "ns", "ms")
"""Units of times, in the kernel's order."""
US_PER = {"s": 1e6, "us": 1.0, "ns": 1e-3}
"""Units of times in arrays, us."""
NANOSECONDS_FROM, _UNIX_MS = 10**17, (1.2e12, 2.2e12)
"""Integer times beyond the first are nanoseconds: in us it would be the year 5138, in
ns it is 1973.  The others are 2008 and 2039 in ms; in us, days of a camera's clock."""
SLOWEST_S = 1.0
"""Mean interval of a recording's events that is beyond any camera's, s."""
ENOUGH = 20
"""Number of lines from which their mean interval is used."""
PNM = re.compile(rb"P[1-7]\s")
"""Beginning of an image that may be text."""
MOST_COLUMNS = 16

NAMES = {"t": "t", "ts": "t", "timestamp": "t", "timestamps": "t", "time": "t",
         "x": "x", "xs": "x", "col": "x", "column": "x", "y": "y", "ys": "y",
         "row": "y", "p": "p", "ps": "p", "pol": "p", "polarity": "p", "on": "p"}
"""Usual names of the columns."""
_UNIT_NAMES = {"us": "us", "usec": "us", "µs": "us", "microseconds": "us", "s": "s",
               "sec": "s", "seconds": "s", "ns": "ns", "nanoseconds": "ns", "ms": "ms",
               "milliseconds": "ms"}
_BREAK = re.compile(r'[\s,;"]+')
_NUMBER = r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"
_VALUE = re.compile(rf"{_NUMBER}|true|false", re.IGNORECASE)
_SIZE = re.compile(r"\s*(\d{1,4})[\s,;x]+(\d{1,4})\s*")
_SIZE_IN_NAME = re.compile(r"@(\d{1,4})$")


@dataclass(slots=True)
class TextForm:
    """The form of a text of events.

    The first event's line begins at the byte `begin` and has so many `columns`; `order`
    tells which of t, x, y, p each is, ``_`` for none of them, "" if the text does not
    say; `names` are theirs, if there are any.  `unit` is that of times that the text
    states, "" if none, `size` the sensor's (height, width); at the `bottom` begin rows
    that are counted as jAER does.
    """

    begin: int = 0
    columns: int = 0
    order: str = ""
    names: tuple[str, ...] = ()
    unit: str = ""
    size: tuple[int, int] | None = None
    bottom: bool = False


def is_text_events(start: bytes) -> bool:
    """Return whether a file begins with lines of four or more numbers, after a header.

    Also whether it is a zip archive that does not hold NumPy's arrays.
    """
    if start.startswith(b"PK\x03\x04"):
        name = start[30:30 + int.from_bytes(start[26:28], "little")]
        return not name.endswith(b".npy")
    return not PNM.match(start) and text_form(start) is not None


def text_form(start: bytes) -> TextForm | None:
    """Return the form of a text from its first lines, of which the last may be cut.

    None if it is no list of numbers.
    """
    form = TextForm(begin=3 if start.startswith(b"\xef\xbb\xbf") else 0)  # byte order
    named = False
    for line in start[form.begin:].split(b"\n")[:-1]:
        if b"\0" in line:       # not a text, or damaged before its first event
            return None
        text = line.decode("latin-1").replace("\xc2\xb5", "µ").strip()
        values = [value for value in _BREAK.split(text) if value]
        if len(values) >= 4 and all(map(_VALUE.fullmatch, values[:4])):
            form.columns = len(values)
            return form
        if text.startswith(("#", "%")):
            form.bottom |= "dvs-events: One event per line" in text
            names = _names(text.rpartition(":")[2])
            if len(names) >= 4 and all(map(_known, names[:4])):   # of columns
                _header(form, names)
        elif form.size is None and not named and (found := _SIZE.fullmatch(text)):
            form.size = int(found[2]), int(found[1])
        elif values and not named and re.match(r"[,;]?[\"'(]?[A-Za-z_]", text):
            named = True
            # A table's first column may be a number without a name, as by pandas.
            _header(form, ["_"] * text.startswith((",", ";")) + _names(text))
        elif values:
            return None
        form.begin += len(line) + 1
    return None


def _names(text: str) -> list[str]:
    """Return the names of columns, each with what follows it in brackets."""
    text = re.sub(r"\s*[(\[]([^)\]]*)[)\]]", lambda found: "_" + re.sub(
        r"[\s,;]+", "_", found[1]), text)
    return [name for name in _BREAK.split(text.strip("#%! ")) if name]


def _known(name: str) -> str:
    """Return which of t, x, y, p a column of this name is, "" if none."""
    first, _, rest = re.sub(r"@\d+$", "", name.lower()).strip("_'").partition("_")
    what = NAMES.get(first, "")
    # A unit may follow, or the values of a polarity.
    fits = not rest or "/" in rest or "=" in rest or (
        what == "t" and _UNIT_NAMES.keys() & set(rest.split("_")))
    return what if fits else ""


def _header(form: TextForm, names: Sequence[str]) -> None:
    """Take the columns' names, and the unit and size in them."""
    form.names = tuple(names)
    columns = [_known(name) for name in names]
    if sorted(filter(None, columns)) == sorted("txyp"):
        form.order = "".join(column or "_" for column in columns)
        time = names[columns.index("t")].lower()
        form.unit = next((_UNIT_NAMES[part] for part in time.split("_")[1:]
                          if part in _UNIT_NAMES), "")
        sides = [_SIZE_IN_NAME.search(names[columns.index(axis)]) for axis in "yx"]
        if sides[0] and sides[1]:
            form.size = int(sides[0][1]), int(sides[1][1])


def rows_of(blocks: Sequence[bytes], order: str) -> Iterator[list[tuple[str, ...]]]:
    """Yield the t, x, y, p of each block's whole lines, as texts."""
    places = [order.index(name) for name in "txyp"]
    for block in blocks:
        rows = []
        for line in block.decode("latin-1").split("\n")[:-1]:
            values = [value for value in _BREAK.split(line) if value]
            if len(values) >= len(order) and all(
                    _VALUE.fullmatch(values[place]) for place in places):
                rows.append(tuple(values[place] for place in places))
        yield rows


def checked_order(path: object, form: TextForm, columns: str | None,
                  blocks: Sequence[bytes]) -> str:
    """Return the order of the columns: of the caller, the names, or t, x, y, p.

    The blocks are parts of the text: if the order is not known, or the numbers
    contradict it, that is a RecordingError.
    """
    if columns is not None:
        if sorted(columns.replace("_", "")) != sorted("txyp"):
            raise ValueError(
                "columns must be the letters txyp in some order, with _ for each "
                f"column of something else, got {columns!r}")
        order = columns
    elif form.order or not form.names:
        order = form.order or "txyp"
    else:
        raise RecordingError(
            f"{path}: its columns are named {', '.join(form.names)}: which are time, "
            "x, y and polarity is stated by columns=, as \"txyp\", _ for another")
    order = order.rstrip("_")
    if len(order) > min(form.columns, MOST_COLUMNS):
        raise RecordingError(
            f"{path}: {len(order)} columns are needed of at most {MOST_COLUMNS}, its "
            f"first line has {form.columns}")
    rows = list(itertools.chain(*rows_of(blocks, order)))
    good = sum(_pixel(x) and _pixel(y) and _value(p) in (-1, 0, 1)
               for _, x, y, p in rows)
    if columns is None and 2 * good < len(rows):
        raise RecordingError(
            f"{path}: its lines are not time, x, y, polarity, as {rows[0]}: the order "
            "of the columns is stated by columns=, as \"xytp\", _ for another")
    return order


def _value(text: str) -> float:
    """Return a number, or that of True or False."""
    lower = text.lower()
    return float(lower == "true") if lower in ("true", "false") else float(text)


def _pixel(text: str) -> bool:
    value = _value(text)
    return 0 <= value < MAX_SIDE and value % 1 == 0


def unit_of(times: NDArray[Any]) -> tuple[str, str]:
    """Return the unit of times, and why it may be wrong, "" if nothing says so.

    Those with fractions are seconds, whole ones microseconds, or nanoseconds beyond
    10**17.
    """
    times = times[np.isfinite(times)]
    odd = int(np.count_nonzero(times % 1))
    if odd > min(len(times) / 10, 8):
        return "s", ""
    middle = float(np.median(times)) if len(times) else 0.0
    unit = "ns" if middle > NANOSECONDS_FROM else "us"
    doubt = f"times near {middle:.4g} are read as us, and may be ms since 1970"
    if not _UNIX_MS[0] < middle < _UNIX_MS[1]:
        doubt = (f"{odd} of the times looked at have fractions, most have none: all "
                 f"are read as {unit}") if odd else ""
    return unit, doubt


def unit_of_times(blocks: Sequence[bytes], order: str) -> tuple[str, str]:
    """Return what `unit_of` does, from all times in parts of a text.

    They are not seconds if there were less than one event in `SLOWEST_S`.
    """
    times = [[_value(row[0]) for row in rows] for rows in rows_of(blocks, order)]
    unit, doubt = unit_of(np.array([*itertools.chain(*times)]))
    if unit != "s":
        return unit, doubt
    slow = [max(block) - min(block) > SLOWEST_S * len(block) for block in times
            if len(block) >= ENOUGH]
    return "us" if slow and all(slow) else "s", ""
