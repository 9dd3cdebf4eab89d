"""Arrays that are not aligned reach no kernel: C may not load from there."""
import numpy as np
import pytest

import pdavis_cv
from pdavis_cv import ApsFrame, Layout, _kernels

VALUES = np.random.default_rng(0).uniform(1, 900, (24, 32))


def unaligned(array):
    """Return a copy whose first byte has an odd address."""
    found = np.frombuffer(bytearray(array.nbytes + 1), array.dtype, array.size, 1)
    found = found.reshape(array.shape)
    found[...] = array
    assert not found.flags.aligned
    return found


@pytest.fixture(autouse=True)
def kernels(monkeypatch):
    """Check the alignment of every array that a kernel is given."""
    called = []

    def checked(kernel):
        def call(*values):
            called.append(kernel)
            for value in values:
                assert not isinstance(value, np.ndarray) or value.flags.aligned or (
                    value.dtype.names), kernel
            return kernel(*values)
        return call

    for name in dir(_kernels):
        if name[0] != "_" and callable(getattr(_kernels, name)):
            monkeypatch.setattr(_kernels, name, checked(getattr(_kernels, name)))
    return called


def _measured(dn):
    frame = ApsFrame(dn, 1, 20)
    recording = pdavis_cv.recording_from_arrays(
        np.zeros(0, pdavis_cv.EVENT_DTYPE), [frame], sensor_size=dn.shape)
    return next(pdavis_cv.fuse(recording, layout=Layout.PDAVIS)).quad


CASES = {
    "demosaic": lambda m, _: pdavis_cv.demosaic(m, Layout.PDAVIS),
    "polarization": lambda m, _: pdavis_cv.polarization(m, Layout.PDAVIS).dolp,
    "stokes": lambda m, q: pdavis_cv.stokes(q)[1],
    "aop": lambda m, _: pdavis_cv.aop(m, m[::-1]),
    "dolp": lambda m, _: pdavis_cv.dolp(m, m, m),
    "fuse": lambda m, _: _measured(m)}


@pytest.mark.parametrize("case", CASES)
def test_floats_are_aligned_before_a_kernel_reads_them(case, kernels):
    plane, quad = VALUES.astype("f4"), np.stack([VALUES] * 4).astype("f4")
    expected = CASES[case](plane, quad)
    kernels.clear()
    np.testing.assert_array_equal(
        CASES[case](unaligned(plane), unaligned(quad)), expected)
    assert kernels


def test_a_result_must_be_aligned():
    plane = VALUES.astype("f4")
    with pytest.raises(ValueError, match="must be aligned to its float32"):
        pdavis_cv.aop(plane, plane, out=unaligned(plane))


def test_reads_of_a_converter_are_aligned_before_a_kernel_reads_them(kernels):
    reset, signal = (VALUES + 90).astype("u2"), VALUES.astype("u2")
    for found, expected in zip(
            pdavis_cv.cds(unaligned(reset), unaligned(signal)),
            pdavis_cv.cds(reset, signal), strict=True):
        np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(pdavis_cv.demosaic(unaligned(reset), Layout.SONY),
                                  pdavis_cv.demosaic(reset, Layout.SONY))
    assert kernels
