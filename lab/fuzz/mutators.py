"""How files are damaged: bytes, numbers, and the grammar of what they hold.

A mutator takes bytes and a generator of random numbers and returns other bytes.  Those
of a grammar take a file apart, change one thing, and put it together again so that
everything around it is right: checksums, sizes, compression.
"""
import contextlib
import io
import pickletools
import re
import struct
import tempfile
import zipfile
from pathlib import Path

import lz4.frame
import numpy as np

INTEGERS = (0, 1, 2, 3, 7, 8, 127, 128, 255, 256, 32767, 32768, 65535, 65536,
            2**24, 2**28, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**48, 2**61, 2**62,
            2**63 - 1, 2**63, 2**64 - 1)
TEXTS = (b"0", b"-1", b"1e308", b"1e999", b"-1e999", b"nan", b"NaN", b"Infinity",
         b"null", b"true", b'""', b"[]", b"{}", b"99999", b"65536", b"4294967296",
         b"9223372036854775807", b"1" * 400, b"0.1", b"1_0", b"[" * 2000,
         b"\xd9\xa3", b"\x00", b"\xff", b'"' + b"a" * 200_000 + b'"')
_NUMBER = re.compile(rb"-?\d+(\.\d+)?")


def some(choices, rng):
    """Return one of a sequence."""
    return choices[int(rng.integers(len(choices)))]


def bytes_(data, rng):
    """Return a copy with a flipped bit or byte, a cut, a hole, a repeat, noise."""
    data = bytearray(data or b"\0")
    kind = int(rng.integers(8))
    at = int(rng.integers(len(data)))
    if kind <= 2:
        data[at] ^= 1 << int(rng.integers(8))
    elif kind == 3:
        data[at] = int(rng.integers(256))
    elif kind == 4:
        del data[at:]
    elif kind == 5:
        del data[at:at + int(rng.integers(1, 64))]
    elif kind == 6:
        data[at:at] = data[at:at + int(rng.integers(1, 4096))]
    else:
        n = int(rng.integers(1, 16))
        data[at:at + n] = rng.bytes(n)
    return bytes(data)


def words(data, rng):
    """Change an integer of 1, 2, 4 or 8 bytes: to the limits, or by a little."""
    size = some((1, 2, 4, 8), rng)
    if len(data) < size:
        return bytes_(data, rng)
    data = bytearray(data)
    at = int(rng.integers(len(data) - size + 1))
    order = some(("little", "little", "big"), rng)
    if rng.integers(2):
        value = some((*INTEGERS, len(data), len(data) - at), rng)
    else:
        value = int.from_bytes(data[at:at + size], order) + int(rng.integers(-9, 10))
    data[at:at + size] = (value & (1 << 8 * size) - 1).to_bytes(size, order)
    return bytes(data)


def numbers(data, rng):
    """Put another text in the place of a number that is written out."""
    found = list(_NUMBER.finditer(data, 0, 1 << 16))
    if not found:
        return words(data, rng)
    one = some(found, rng)
    return data[:one.start()] + some(TEXTS, rng) + data[one.end():]


def blocks(data, rng):
    """Exchange, repeat or clear blocks of bytes."""
    if len(data) < 4:
        return bytes_(data, rng)
    a, b, c, d = sorted(int(i) for i in rng.integers(len(data) + 1, size=4))
    kind = int(rng.integers(3))
    if kind == 0:
        return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]
    if kind == 1:
        return data[:b] + data[a:b] * int(rng.integers(1, 4)) + data[b:]
    return data[:a] + bytes(b - a) + data[b:]


PLAIN = (bytes_, bytes_, words, words, numbers, blocks)


def damaged(data, rng):
    """Return a copy that is damaged without knowledge of what it is."""
    for _ in range(int(rng.integers(1, 4))):
        data = some(PLAIN, rng)(data, rng)
    return data or b"\0"


def overwritten(data, rng):
    """Return a copy of the same length: bits, bytes or numbers that others replaced."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        at, count = int(rng.integers(len(out))), int(rng.integers(1, 17))
        kind = int(rng.integers(4))
        if kind == 0:
            out[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            out[at:at + count] = rng.bytes(len(out[at:at + count]))
        elif kind == 2:
            out[at:at + count] = bytes(len(out[at:at + count]))
        elif len(out) >= 8:
            out = bytearray(words(bytes(out), rng))
    return bytes(out)


def mutant(data, grammar, rng):
    """Return a copy that is damaged, half of the time by its grammar."""
    if grammar and rng.integers(2):
        with contextlib.suppress(*BROKEN):     # of an earlier mutation
            data = some(grammar, rng)(data, rng)
        if rng.integers(3):
            return data
    return damaged(data, rng)


BROKEN = (ValueError, KeyError, IndexError, OSError, RuntimeError, struct.error,
          EOFError, NotImplementedError, zipfile.BadZipFile)

# AEDAT-4, and DV's protocol, which has neither magic nor index ---------------------


def _packed(payload, name):
    if name == "lz4":
        return lz4.frame.compress(payload, store_size=False)
    if name == "zstd":
        import zstandard
        return zstandard.compress(payload)
    return payload


def _unpacked(payload):
    if payload[:4] == b"\x04\x22\x4d\x18":
        return lz4.frame.decompress(payload), "lz4"
    if payload[:4] == b"\x28\xb5\x2f\xfd":
        import zstandard
        return zstandard.ZstdDecompressor().decompressobj().decompress(payload), "zstd"
    return payload, "none"


def _taken_apart(data, begin):
    """Return header, packets as (stream, payload), and what follows them."""
    at = begin + 4 + int.from_bytes(data[begin:begin + 4], "little")
    head, packets = data[:at], []
    while at + 8 <= len(data):
        stream, size = struct.unpack_from("<ii", data, at)
        if not 0 <= stream < 4 or not 0 < size <= len(data) - at - 8:
            break
        packets.append((stream, data[at + 8:at + 8 + size]))
        at += 8 + size
    return head, packets, data[at:]


def _together(head, packets, rest):
    return head + b"".join(
        struct.pack("<ii", stream, len(payload)) + payload
        for stream, payload in packets) + rest


def _table(data, rng):
    """Change what a FlatBuffer's table says: offsets, sizes, its vtable."""
    if len(data) < 16:
        return words(data, rng)
    out = bytearray(data)
    root = 4 + int.from_bytes(data[4:8], "little")
    places = [0, 4, root]
    with contextlib.suppress(struct.error):
        vtable = root - struct.unpack_from("<i", data, root)[0]
        length, = struct.unpack_from("<H", data, vtable)
        places += range(vtable, vtable + min(length, 64), 2)
        for slot in range(vtable + 4, vtable + min(length, 64), 2):
            field, = struct.unpack_from("<H", data, slot)
            places += [root + field] if field else []
            vector = root + field + struct.unpack_from("<I", data, root + field)[0]
            places += [vector, vector + 4]
    at = some([p for p in places if 0 <= p <= len(data) - 2], rng)
    size = min(some((2, 4), rng), len(data) - at)
    value = some((*INTEGERS, len(data), len(data) - at, at), rng) if (
        rng.integers(2)) else (
        int.from_bytes(out[at:at + size], "little") + int(rng.integers(-9, 10)))
    out[at:at + size] = (value & (1 << 8 * size) - 1).to_bytes(size, "little")
    return bytes(out)


def _flatbuffers(begin):
    def mutated(data, rng):
        """Change a FlatBuffer inside its compression: header, a packet or the index."""
        head, packets, rest = _taken_apart(data, begin)
        which = int(rng.integers(len(packets) + 2))
        change = some((_table, _table, words, blocks, bytes_), rng)
        if which < len(packets):
            stream, payload = packets[which]
            inner, name = _unpacked(payload)
            packets[which] = stream, _packed(change(inner, rng), name)
        elif which == len(packets) and rest:
            inner, name = _unpacked(rest)
            rest = _packed(change(inner, rng), name)
        else:
            text = some((_table, numbers, numbers, _xml), rng)(head[begin:], rng)
            size = len(text) - 4
            head = head[:begin] + struct.pack("<I", max(size, 0)) + text[4:]
        return _together(head, packets, rest)
    return mutated


def _xml(text, rng):
    """Change the tree that describes streams."""
    kind = int(rng.integers(16))
    at = text.find(b"<node", int(rng.integers(len(text))))
    if at < 0:
        return numbers(text, rng)
    if kind == 0:
        return text[:at] + b"<node>" * 3000 + text[at:]
    if kind == 1:
        entities = b'<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">' + b"".join(
            b'<!ENTITY %c "%s">' % (98 + i, b"&%c;" % (97 + i) * 10)
            for i in range(8)) + b"]>"
        begin = text.find(b"<")
        return text[:begin] + entities + text[begin:at] + b"&h;" + text[at:]
    if kind < 9:
        end = text.find(b"</node>", at)
        return text[:at] + text[at:end + 7] * 2 + text[end + 7:]
    return text.replace(some((b"EVTS", b"FRME", b"IMUS", b"TRIG", b"size"), rng),
                        some((b"EVTS", b"FRME", b"POSE", b"\xc3\xa4"), rng))


def _frames(begin):
    def mutated(data, rng):
        """Change the frame of a compression: flags, sizes, or a bomb in its place."""
        head, packets, rest = _taken_apart(data, begin)
        which = int(rng.integers(len(packets)))
        stream, payload = packets[which]
        kind = int(rng.integers(4))
        if kind == 0:
            at = 4 + int(rng.integers(min(11, len(payload) - 4)))
            payload = payload[:at] + rng.bytes(1) + payload[at + 1:]
        elif kind == 1:
            inner, name = _unpacked(payload)
            size = 1 << int(rng.integers(10, 27) if rng.integers(16) == 0 else 16)
            told = some((size - 4, len(inner) - 4, 2**31 - 1), rng)
            name = "lz4" if name == "none" else name    # a bomb must be small
            payload = _packed(
                struct.pack("<I", told) + inner[4:] + bytes(size - len(inner)), name)
        elif kind == 2:
            inner, _ = _unpacked(payload)
            payload = _packed(inner, some(("lz4", "zstd", "none"), rng))
        else:
            payload = payload + payload
        packets[which] = stream, payload
        return _together(head, packets, rest)
    return mutated


def _order(begin):
    def mutated(data, rng):
        """Exchange, repeat, drop or misname packets, or change the index's place."""
        head, packets, rest = _taken_apart(data, begin)
        a, b = (int(i) for i in rng.integers(len(packets), size=2))
        kind = int(rng.integers(4))
        if kind == 0:
            packets[a], packets[b] = packets[b], packets[a]
        elif kind == 1:
            packets.insert(a, packets[b])
        elif kind == 2:
            del packets[a]
        else:
            packets[a] = int(rng.integers(-1, 6)), packets[a][1]
        return _together(head, packets, rest)
    return mutated


AEDAT4 = (_flatbuffers(14), _flatbuffers(14), _frames(14), _order(14))
AEDAT4_STREAM = (_flatbuffers(0), _flatbuffers(0), _frames(0), _order(0))

# Archives and arrays of NumPy, pickles ---------------------------------------------


def _zipped(data, rng, change, pick=None):
    """Change one member of an archive; the rest is as it was."""
    made = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(made, "w") as new:
        names = old.namelist()
        wanted = [n for n in names if pick is None or pick(n)]
        if not wanted:
            raise ValueError("nothing of the kind in it")
        hit = some(wanted, rng)
        for name in names:
            inner = old.read(name)
            kind = old.getinfo(name).compress_type
            for other, content in change(name, inner, rng) if name == hit else (
                    (name, inner),):
                new.writestr(zipfile.ZipInfo(other), content, compress_type=kind)
    return made.getvalue()


def _members(data, rng):
    """Change, rename, repeat, empty or drop a member of an archive."""
    def change(name, inner, rng):
        kind = int(rng.integers(6))
        if kind == 0:
            return [(name, damaged(inner, rng))]
        if kind == 1:
            return [(some(("", "/x", "../x", "a" * 300, "\N{SNOWMAN}", "head.npy",
                           "about.npy", "x.npy", "t.npy"), rng), inner)]
        if kind == 2:
            return [(name + "2", inner), (name, inner)]
        if kind == 3:
            return [(name, b"")]
        if kind == 4:
            return []
        return [(name, inner + bytes(some((10, 1 << 10, 1 << 10, 1 << 20), rng)))]
    import warnings
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")     # of names that are there already
        return _zipped(data, rng, change)


def _directory(data, rng):
    """Change the archive's own numbers: sizes, methods, flags, places."""
    places = [m.start() for m in re.finditer(rb"PK(\x01\x02|\x03\x04|\x05\x06)", data)]
    out = bytearray(data)
    at = some(places, rng) + 4 + 2 * int(rng.integers(21))
    size = some((2, 4), rng)
    value = some((*INTEGERS, 8, 9, 12, 14, 93, 99), rng)
    out[at:at + size] = (value & (1 << 8 * size) - 1).to_bytes(size, "little")
    return bytes(out)


_SHAPES = ("()", "(0,)", "(1,)", "(-1,)", "(2**40,)", "(1099511627776,)",
           "(4611686018427387904,)", "(1<<70,)", "(9223372036854775808,)", "(2, 2)",
           "(65536, 65536, 4)", "(0, 1099511627776)", "(True,)", "(1.0,)", "('a',)",
           "(" * 80 + ")" * 80, "60", "None", "{}", "(60,)", "(4, 6, 3)")
_TYPES = ("'<f4'", "'>f8'", "'|O'", "'<c16'", "'|b1'", "'<U12'", "'|S5'", "'|V13'",
          "'<m8[us]'", "'<M8[Y]'", "'<f2'", "'<u8'", "[('t', '<i8'), ('x', 'O')]",
          "[('t', '<i8'), ('x', '<u2'), ('y', '<u2'), ('p', '|u1')]", "'<f4, <i8'",
          "[('t', '<i8', (9,)), ('x', '<u2'), ('y', '<u2'), ('p', '|u1')]",
          "'|S0'", "'<U1073741823'", "None", "3", "('<f4', (1000000,))")


def _npy(inner, rng):
    """Write another header before an array's numbers."""
    if inner[:6] != b"\x93NUMPY":
        return damaged(inner, rng)
    length = int.from_bytes(inner[8:10], "little")
    head = inner[10:10 + length].decode("latin-1")
    kind = int(rng.integers(4))
    if kind == 0:
        head = re.sub(r"'shape': \([^)]*\)",
                      lambda _: f"'shape': {some(_SHAPES, rng)}", head)
    elif kind == 1:
        head = re.sub(r"'descr': (\[.*?\]|'[^']*')",
                      lambda _: f"'descr': {some(_TYPES, rng)}", head)
    elif kind == 2:
        head = head.replace("False", some(("True", "0", "None", "'x'"), rng))
    else:
        head = some(("{}", "", "{'descr': '<f4'}", "[" * 9000, "\0" * 64, "-" * 500),
                    rng)
    text = head.encode("latin-1").rstrip() + b"\n"
    version = bytes((some((1, 1, 1, 2, 3, 9), rng), 0))
    size = struct.pack("<H" if version[0] == 1 else "<I", len(text))
    return b"\x93NUMPY" + version + size + text + inner[10 + length:]


def _arrays(data, rng):
    """Change the header of an array, in an archive or by itself."""
    if data[:2] != b"PK":
        return _npy(data, rng)
    return _zipped(data, rng, lambda name, inner, rng: [(name, _npy(inner, rng))],
                   lambda name: name.endswith(".npy"))


def _json(data, rng):
    """Change the text that a file's own facts are."""
    def change(name, inner, rng):
        length = int.from_bytes(inner[8:10], "little")
        text = np.lib.format.read_array(io.BytesIO(inner)).item()
        made = io.BytesIO()
        np.lib.format.write_array(made, np.array(
            numbers(text.encode(), rng).decode("latin-1")))
        return [(name, made.getvalue() if length else inner)]
    return _zipped(data, rng, change, lambda name: name in ("head.npy", "about.npy"))


ARCHIVES = (_members, _directory)
ARRAYS = (*ARCHIVES, _arrays, _arrays, _json)

_OPCODES = [op for op in pickletools.opcodes if op.code != "."]
_NAMES = (b"os\nsystem", b"builtins\neval", b"collections\nOrderedDict",
          b"torch._utils\n_rebuild_tensor_v2", b"torch\nFloatStorage", b"torch\nSize",
          b"numpy\ndtype", b"_codecs\nencode", b"mine\nThing", b"posix\nsystem",
          b"torch._utils\n_rebuild_parameter", b"datetime\ndatetime")


def _opcode(rng):
    """Return an opcode with an argument of its kind."""
    op = some(_OPCODES, rng)
    code = op.code.encode("latin-1")
    if op.arg is None:
        return code
    name, value = op.arg.name, int(some(INTEGERS, rng))
    if name in ("uint1", "uint2", "int4", "uint4", "uint8"):
        size = int(name[-1])
        return code + (value & (1 << 8 * size) - 1).to_bytes(size, "little")
    if name.startswith("stringnl_noescape_pair"):
        return code + some(_NAMES, rng) + b"\n"
    if name.endswith(("1", "4", "8")):     # a counted string of bytes
        size, text = int(name[-1]), some((b"", b"x", b"state_dict", b"a" * 200), rng)
        told = some((len(text), value), rng)
        return code + (told & (1 << 8 * size) - 1).to_bytes(size, "little") + text
    if name == "float8":
        return code + rng.bytes(8)
    return code + some((b"1", b"x", b"'a'", b"1e9", b"9" * 5000), rng) + b"\n"


def _opcodes(inner, rng):
    at = [place for *_, place in pickletools.genops(inner)]
    out = inner
    for _ in range(int(rng.integers(1, 5))):
        place = some(at, rng)
        kind = int(rng.integers(3))
        cut = 0 if kind == 0 else int(rng.integers(1, 12))
        out = out[:place] + (b"" if kind == 1 else _opcode(rng)) + out[place + cut:]
    return out


def _pickles(data, rng):
    """Insert, drop or exchange opcodes of an archive's pickle."""
    return _zipped(data, rng, lambda name, inner, rng: [(name, _opcodes(inner, rng))],
                   lambda name: name.endswith(".pkl"))


PICKLES = (_pickles, _pickles, _pickles, _members)

# Tables, requests ------------------------------------------------------------------


def _lines(data, rng):
    """Exchange, repeat, drop or join lines, or change a cell."""
    rows = data.split(b"\n")
    a, b = (int(i) for i in rng.integers(len(rows), size=2))
    kind = int(rng.integers(5))
    if kind == 0:
        rows[a], rows[b] = rows[b], rows[a]
    elif kind == 1:
        rows.insert(a, rows[b])
    elif kind == 2:
        del rows[a]
    elif kind == 3:
        rows[a] = rows[a].replace(b" ", some((b",", b";", b"\t", b'"'), rng))
    else:
        mark = some((b",", b";", b" ", b"\t"), rng)
        cells = rows[a].split(mark)
        cells[int(rng.integers(len(cells)))] = some((*TEXTS, b"", b"N", b"kN"), rng)
        rows[a] = mark.join(cells)
    return b"\n".join(rows)


TABLES = (_lines, _lines, numbers)

_HEADERS = (b"Host: evil.example", b"Host:", b"Host: [::1", b"Origin: null",
            b"Content-Length: -1", b"Content-Length: 99999999999",
            b"Content-Length: 5", b"Transfer-Encoding: chunked",
            b"Expect: 100-continue", b"Authorization: Bearer \xff",
            b"Sec-Fetch-Site: cross-site", b"X" * 70_000,
            b"Connection: keep-alive", b"Content-Type: application/json; charset=x",
            b" folded", b"\x00: \x00")
_PATHS = (b"/../../etc/passwd", b"/stream.mjpg?output=aop_bgr", b"//", b"*",
          b"http://[::1/", b"/%00", b"?" * 9, b"/images",
          b"/status?palettes&palettes=1", b"/snapshot.npz", b"/" + b"a" * 70_000,
          b"/page.js")
_VALUES = (b"1", b"-1", b"1e400", b"NaN", b"null", b"true", b"[]", b'[0,0,16,12]',
           b"[0,0,-2,4]", b'"frames"', b'"cf"', b'"\\ud800"', b"[" * 3000, b"{}",
           b"9" * 5000, b'{"a":1}', b"[1e308,1,2,3]", b"0.0001", b"1000")
_DO = (b"seek", b"step", b"play", b"pause", b"speed", b"method", b"fps",
       b"record", b"change", b"__init__", b"")


def _requests(data, rng):
    """Change what a request asks for, its headers, or what it commands."""
    kind = int(rng.integers(4))
    if kind == 0:
        line, rest = data.split(b"\r\n", 1)
        words_ = line.split(b" ")
        words_[int(rng.integers(len(words_)))] = some(
            (*_PATHS, b"GET", b"POST", b"HEAD", b"PUT", b"HTTP/0.9", b"HTTP/9.9"), rng)
        return b" ".join(words_) + b"\r\n" + rest
    if kind == 1:
        return data.replace(b"\r\n", b"\r\n" + some(_HEADERS, rng) + b"\r\n", 1)
    if kind == 2:
        return data + data
    body = b'{"do": "%s", "value": %s}' % (some(_DO, rng), some(_VALUES, rng))
    return (b"POST /command HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/"
            b"json\r\nContent-Length: %d\r\n\r\n%s" % (len(body), body))


REQUESTS = (_requests, _requests, numbers)

# HDF5 ------------------------------------------------------------------------------

_SIGNATURES = re.compile(
    rb"\x89HDF\r\n\x1a\n|TREE|HEAP|SNOD|OHDR|OCHK|GCOL|FRHP|FHDB|FHIB|BTHD|BTLF|BTIN"
    rb"|EAHD|FAHD")


def _structures(data, rng):
    """Change an integer in one of HDF5's own structures."""
    at = some([found.end() for found in _SIGNATURES.finditer(data)], rng)
    end = min(at + 96, len(data))
    return data[:at] + words(data[at:end], rng) + data[end:]


def _messages(data, rng):
    """Change an integer in a message of an object's header (attributes, types)."""
    # Headers of version 1: version, 0, count of messages, references, size; then
    # messages: type below 24, size, flags, three zeros.
    found = [m.start() for m in re.finditer(
        rb"[\x00-\x17]\x00[\x08-\xff][\x00-\x03][\x00-\x07]\x00\x00\x00", data)]
    at = some(found, rng)
    end = min(at + 8 + int.from_bytes(data[at + 2:at + 4], "little"), len(data))
    return data[:at] + words(data[at:end], rng) + data[end:]


def _rewritten(data, rng):
    """Let HDF5 itself put another thing in the place of a dataset or an attribute."""
    import h5py
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.h5"
        path.write_bytes(data)
        with h5py.File(path, "r+") as file:
            names = []
            file.visit(names.append)
            name = some(names, rng)
            values = (np.zeros((2, 4)), np.zeros(0), np.float64("nan"), b"text", "\xe4",
                      np.zeros((3, 12, 16), np.uint8), np.array([b"a", b"bc"]),
                      np.full(5, np.inf), np.arange(9)[::-1], np.zeros(5, "i8,f4"),
                      h5py.Empty("f4"), np.full(40, 2**63 - 1), np.full(40, -2**63))
            value = some(values, rng)
            kind = int(rng.integers(5))
            if kind == 0:
                holder = file[some(["/", *names], rng)]
                keys = list(holder.attrs) or ["sensor_size"]
                holder.attrs[some(keys, rng)] = value
            elif kind == 1:
                del file[name]
                file[name] = value
            elif kind == 2:
                del file[name]
                file[name] = some((h5py.SoftLink("/"), h5py.SoftLink("/" + name),
                                   h5py.ExternalLink("x.h5", "/"),
                                   h5py.ExternalLink("no.h5", "/a")), rng)
            elif kind == 3:
                del file[name]
                file.create_group(name)
            else:
                del file[name]
                shape = some(((5,), (5, 4), (1 << 20, 4), (0, 4)), rng)
                file.create_dataset(name, shape, some(("i8", "f4", "u1", "S3"), rng),
                                    chunks=tuple(max(1, min(s, 64)) for s in shape))
        return path.read_bytes()


HDF5 = (_structures, _structures, _messages, _messages, _rewritten)
