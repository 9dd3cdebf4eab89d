import numpy as np
import pytest

from pdavis_cv._checks import output, positive, sensor_shape


def test_without_out_a_new_array_is_made():
    array = output(None, (2, 3), np.float32)
    assert (array.shape, array.dtype) == ((2, 3), np.float32)


def test_a_fit_out_is_returned_itself():
    out, other = np.zeros((2, 3), np.float32), np.zeros((2, 3), np.float32)
    assert output(out, (2, 3), np.float32, other, None) is out


READ_ONLY = np.zeros((2, 3), np.float32)
READ_ONLY.flags.writeable = False


@pytest.mark.parametrize(("out", "error", "message"), [
    ([[0.0] * 3] * 2, TypeError, "out must be an ndarray, got list"),
    (np.zeros((2, 3)), TypeError, "out must be float32, got float64"),
    (np.zeros((3, 2), np.float32), ValueError, r"must have shape \(2, 3\), got \(3, 2"),
    (np.zeros((3, 2), np.float32).T, ValueError, "C-contiguous, got strides"),
    (READ_ONLY, ValueError, "writeable, got a read-only array"),
])
def test_an_unfit_out_is_refused(out, error, message):
    with pytest.raises(error, match=message):
        output(out, (2, 3), np.float32)


def test_out_must_not_overlap_an_input():
    memory = np.zeros(12, np.float32)
    out = memory[:6].reshape(2, 3)
    assert output(out, (2, 3), np.float32, memory[6:]) is out
    with pytest.raises(ValueError, match="out must not overlap an input"):
        output(out, (2, 3), np.float32, memory[5:])


def test_an_input_that_is_interleaved_with_out_does_not_overlap():
    memory = np.zeros((4, 2), np.float32)
    assert output(memory[1], (2,), np.float32, memory[::2]).base is memory


@pytest.mark.parametrize("value", [0, -1, float("nan"), float("inf")])
def test_only_positive_finite_numbers_are_positive(value):
    assert positive("rate", 2) == 2.0
    with pytest.raises(ValueError, match="rate must be positive and finite, got"):
        positive("rate", value)


def test_a_sensor_has_two_positive_sides():
    assert sensor_shape([260, 346]) == (260, 346)
    for bad in ((1,), (0, 3), (3, 70_000), "ab"):
        with pytest.raises(ValueError, match="shape must"):
            sensor_shape(bad)
