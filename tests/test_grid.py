"""Times of images on a regular grid, against the rule in exact fractions."""
from fractions import Fraction

from hypothesis import given, strategies as st

from pdavis_cv.fusion.grid import grid_count, grid_us

RATES = st.fractions(Fraction(1, 10), 2_000_000, max_denominator=1001)


@given(st.integers(0, 10**9), RATES)
def test_an_image_is_at_the_whole_microsecond_nearest_to_its_time(k, fps):
    assert grid_us(k, fps) == round(k * 1_000_000 / fps)


@given(st.integers(-10, 10**12), RATES)
def test_the_images_that_are_counted_are_those_before_the_end(span_us, fps):
    count = grid_count(span_us, fps)
    assert count == 0 or grid_us(count - 1, fps) < span_us
    assert grid_us(count, fps) >= span_us
