"""Ten thousand hostile calls of public functions: an answer or a documented error."""
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from boundaries import hostile, table
from boundary_scenes import kinds

from pdavis_cv.fusion.options import FusionOptions
from pdavis_cv.simulation import ApsPixel

HERE = Path(__file__).parent


@pytest.mark.gate
def test_hostile_arguments_are_answered_or_refused():
    # A process of its own: what crashes must not take the tests with it.
    run = subprocess.run([sys.executable, "-P", str(HERE / "boundaries.py")],
                         capture_output=True, text=True, timeout=900, check=False)
    assert run.returncode == 0, run.stdout[-2000:] + run.stderr[-2000:]
    *complaints, last = run.stdout.splitlines()
    assert not complaints
    assert int(last.split()[0]) >= 10_000


def test_the_table_calls_everything_rightly():
    for name, function, good in table():
        function(**good)
        assert name


def test_an_impossible_part_of_a_simulation_is_named():
    refused = []
    for name, kind, good, _ in kinds():
        for argument, value in good.items():
            for bad in hostile(value):
                try:
                    kind(**{**good, argument: bad})
                except ValueError as error:
                    refused.append((name, argument, str(error)))
    assert len(refused) > 3000
    assert not [each for each in refused if each[1] not in each[2]]


def test_small_integers_of_numpy_are_taken_for_numbers():
    # In int8, 22 + 20000 is an OverflowError.
    options = FusionOptions(fps=np.uint8(163), start_us=np.int8(22))
    assert (options.fps, options.start_us) == (163, 22)
    assert {type(options.fps), type(options.start_us)} == {int}
    pixel = ApsPixel(fps=np.uint8(20), exposure_us=np.int16(20_000))
    assert {type(pixel.fps), type(pixel.exposure_us)} == {int}
