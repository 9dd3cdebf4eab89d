"""Unpacking 10- and 12-bit pixels."""
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import reference
from hypothesis import given, strategies as st

from pdavis_cv import unpack
from pdavis_cv.packed import PACKINGS

BITS = {"10p": 10, "12p": 12, "10packed": 10, "12packed": 12}


def twin(data, packing, n):
    split = reference.unpack_lsb_first if packing.endswith("p") else (
        reference.unpack_in_pairs)
    return split(data, BITS[packing], n)


@pytest.mark.parametrize("packing", PACKINGS)
@given(data=st.binary(min_size=0, max_size=60), cut=st.integers(0, 3))
def test_unpack_matches_reference(packing, data, cut):
    raw = np.frombuffer(data, np.uint8)
    group = 4 if packing == "10p" else 2
    size = 5 if packing == "10p" else 3
    n = max(len(data) // size * group - cut, 0)
    np.testing.assert_array_equal(unpack(data, packing, (n,)), twin(raw, packing, n))


@pytest.mark.parametrize("packing", ["10p", "12p"])
def test_unpack_undoes_packing(packing):
    bits = BITS[packing]
    pixels = np.random.default_rng(0).integers(0, 2**bits, (7, 11))
    stream = (pixels.reshape(-1, 1) >> np.arange(bits)) & 1
    packed = np.packbits(stream.astype(np.uint8).ravel(), bitorder="little")
    np.testing.assert_array_equal(unpack(packed, packing, (7, 11)), pixels)


def test_the_documented_groups():
    # GigE Vision: 12 bits 0xABC and 0xDEF are AB, FC, DE; 10 bits 0x3F1, 0x002.
    assert unpack(b"\xab\xfc\xde", "12packed", (2,)).tolist() == [0xABC, 0xDEF]
    assert unpack(b"\xfc\x21\x00", "10packed", (2,)).tolist() == [0x3F1, 0x002]
    # PFNC: the first pixel starts at bit 0 of byte 0.
    assert unpack(b"\xbc\xfa\xde", "12p", (2,)).tolist() == [0xABC, 0xDEF]


@pytest.mark.parametrize("packing", PACKINGS)
@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 8])
def test_one_byte_less_is_refused(packing, n):
    whole = next(size for size in range(20) if _fits(packing, n, size))
    in_pairs = packing.endswith("packed")
    assert whole == ((3 * n + 1) // 2 if in_pairs else -(-n * BITS[packing] // 8))
    with pytest.raises(ValueError, match=f"must hold {whole} bytes for {n} pixels"):
        unpack(bytes(whole - 1), packing, (n,))


def _fits(packing, n, size):
    try:
        unpack(bytes(size), packing, (n,))
    except ValueError:
        return False
    return True


def test_unpack_refuses_what_it_cannot_read():
    with pytest.raises(ValueError, match="packing must be one of 10p"):
        unpack(b"", "14p", (1,))
    with pytest.raises(TypeError, match="data must be bytes or uint8, got uint16"):
        unpack(np.zeros(9, np.uint16), "12p", (1,))


def test_input_may_be_strided_and_read_only_and_is_left_alone():
    raw = np.arange(60, dtype=np.uint8)
    before = raw.copy()
    raw.flags.writeable = False
    np.testing.assert_array_equal(
        unpack(raw[::2], "12p", (20,)), twin(raw[::2], "12p", 20))
    np.testing.assert_array_equal(raw, before)


def test_threads_can_unpack_at_once():
    raw = np.random.default_rng(1).integers(0, 256, 3000, np.uint8)
    expected = twin(raw, "12packed", 2000)
    with ThreadPoolExecutor(8) as pool:
        for got in pool.map(lambda _: unpack(raw, "12packed", (2000,)), range(32)):
            np.testing.assert_array_equal(got, expected)
