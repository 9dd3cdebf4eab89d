import numpy as np
import pytest

import pdavis_cv
from pdavis_cv import Layout
from pdavis_cv.mosaic import demosaic_valid


def test_a_linear_ramp_demosaics_to_itself():
    y, x = np.mgrid[:7, :9]
    ramp = (100 + 3 * x + 5 * y).astype(np.uint16)
    for plane in pdavis_cv.demosaic(ramp, Layout.PDAVIS):
        np.testing.assert_array_equal(plane, ramp)


def test_an_invalid_pixel_spoils_its_neighbours_only():
    valid = np.ones((10, 10), bool)
    valid[4, 4] = False
    spoilt = ~demosaic_valid(valid, Layout.PDAVIS)
    assert np.argwhere(spoilt).min() == 3
    assert spoilt.sum() == 3 * 3


def test_superpixel_needs_even_sides():
    with pytest.raises(ValueError, match="even height and width"):
        pdavis_cv.demosaic(np.zeros((3, 4), np.uint8), Layout.SONY, "superpixel")
