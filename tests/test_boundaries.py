"""Ten thousand hostile calls of public functions: an answer or a documented error."""
import subprocess
import sys
from pathlib import Path

import pytest
from boundaries import table

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
