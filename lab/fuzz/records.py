"""Where the records of formats lie that are not made of packets, and what they hold.

A record is the least that a format lets one tell apart: a line, a row, a word, in EVT2
and EVT3 the words from one time to the next, in a bag a message.  Bytes that are
overwritten there cost the events of that record, and at most one beside it: of two
events whose times are not in order nothing says which is wrong.  An upper time of EVT2
or EVT3 that is a little ahead may also cost those of the next two, which seem late, and
one that is lost up to eight before the next.
"""
import re

import corpus
import numpy as np
from event_bytes import ros1_message, ros2_message, ros_parts


def lines(data):
    """Yield (first byte, byte after the last) of the lines of a text.

    But the first, by which the file is known to be one.
    """
    for found in re.finditer(rb"(?<=\n)[^\n]+", data):
        yield found.span()


def rows(data, begin, size):
    """Yield the same of records of one size, to the end of a file."""
    for at in range(begin, len(data) - size + 1, size):
        yield at, at + size


def lists(data):
    """Yield the same of a text, or of an array of NumPy; of an archive nothing."""
    if data[:6] == b"\x93NUMPY":
        yield from rows(data, 10 + int.from_bytes(data[8:10], "little"), 13)
    elif data[:2] != b"PK":
        yield from lines(data)


def aedat2(data):
    """Yield the same of words with their times."""
    yield from rows(data, data.rindex(b"#End Of ASCII Header\r\n") + 22, 8)


def prophesee(data):
    """Yield the same of the events of DAT, of words with one time of EVT2 and EVT3.

    But those of the first time: no other tells whether it is wrong.
    """
    if data.startswith(b"% Data"):
        yield from rows(data, data.index(b"\n", data.index(b"% Width")) + 3, 8)
        return
    begin = data.index(b"% end\n") + 6
    two = data.startswith(b"% evt 2.0")
    words = np.frombuffer(data, "<u4" if two else "<u2", offset=begin)
    kinds = words >> (28 if two else 12)
    starts = np.flatnonzero(kinds == 8)
    if not two:     # a row goes on beyond a time
        starts = np.array([i for i in starts if kinds[i + 1:i + 3].tolist() == [6, 0]])
    ends = [*starts[1:], len(words)]
    for start, stop in [*zip(starts, ends, strict=True)][1:]:
        yield begin + int(start) * words.itemsize, begin + int(stop) * words.itemsize


def bags(data):
    """Yield (first byte, byte after the last, places of the events) of messages."""
    size = (12, 16)
    message = ros1_message if data.startswith(b"#ROSBAG") else ros2_message
    for events in ros_parts(corpus.small(size, 0).events()):
        made = message(events, size)
        at = data.index(made)
        yield at, at + len(made), events["y"].astype(np.int64) << 16 | events["x"]
