"""Numbers in estimators have names that say what they are."""
import textwrap
from pathlib import Path

import pytest
from literals import bare, literals

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("pdavis_cv/reconstruct/kalman/*.py",
         *(f"pdavis_cv/reconstruct/{name}.py" for name in (
             "cf", "denoise", "events", "lamp", "model", "redundancy", "tracks")),
         "pdavis_cv/recording/advice.py", "pdavis_cv/fusion/learning.py",
         "pdavis_cv/fusion/online_learning.py", "pdavis_cv/fusion/events_alone.py",
         *(f"_kernels/_{name}.*" for name in (
             "estimate", "lag", "lamp", "leaky", "model", "redundancy", "store",
             "tracks")))
FILES = sorted(path.relative_to(ROOT).as_posix() for room in ROOMS
               for path in ROOT.glob(room)
               if path.suffix in (".py", ".pyx", ".pxd", ".h"))
OPEN: dict[str, int] = {}
"""Numbers without a name that a file still has; this list may only get shorter."""

SAID = {
    "x.py": '''
        GAP_US = 250    # typical refractory period, data sheet

        # Prior standard deviation, ln units (Brandli 2014).
        SIGMA, SHARE = 0.035, 0.7

        HZ = 300.0
        """Corner frequency in Hz, v2e's default."""

        def half(x, sigma=SIGMA):
            return 0.5 * max(x[7], 0) + 1e-6 * 4
        ''',
    "x.pyx": '''
        """A docstring with 17 numbers in 3.5 lines."""
        cdef extern from *:
            """
            #define LAG 0.33  /* of a threshold, lab/studies/lag.py */
            static const double POLE = 5.5;  /* Hz, data sheet */
            """
        # Places of the state, in the order of docs/theory
        cdef enum:
            SUM = 19
            SINCE = 21

        def f(double[:, ::1] state not None):
            cdef double share = 0.15   # of the variance, lab/studies/share.py
            if state.shape[1] != 9:
                raise ValueError("f: state must be (n, 9)")
            return state[0, 8] * 0.5 + share  # not 0.75
        '''}
BARE = {
    "x.py": ('''
        SIGMA = 0.035

        def f(x, share=0.7):
            y = max(12, 0.5) + 1e-3
            return x ** 0.33  # a power of it
        ''', ["0.035", "0.7", "0.5", "12", "1e-3", "0.33"]),
    "x.pyx": ('''
        cdef extern from *:
            """
            static double f(double x) { return 0.33 * x; } /* a third of it */
            """
        cdef enum:
            SUM = 19

        def f(double x):
            # a share of all
            cdef double y = 0.15 * x + 7e-2, z = 1e12 + 1e-6
            y += 0x1f   # thirty one of them
            return y
        ''', ["0.33", "19", "0.15", "7e-2", "1e12", "1e-6", "0x1f"])}


def written(path, text):
    path.write_text(textwrap.dedent(text).lstrip("\n"))
    return path


@pytest.mark.parametrize("name", list(SAID))
def test_numbers_with_a_name_and_a_word_on_it_pass(tmp_path, name):
    path = written(tmp_path / name, SAID[name])
    assert [str(one) for one in bare(path)] == []
    assert len(literals(path)) > 3


@pytest.mark.parametrize("name", list(BARE))
def test_other_numbers_are_found(tmp_path, name):
    text, want = BARE[name]
    assert [one.text for one in bare(written(tmp_path / name, text))] == want


def test_the_rooms_are_where_they_are_looked_for():
    rooms = {name.rsplit("/", 1)[0] for name in FILES}
    assert rooms == {"pdavis_cv/reconstruct/kalman",
                     "pdavis_cv/reconstruct", "pdavis_cv/recording",
                     "pdavis_cv/fusion", "_kernels"}
    assert set(OPEN) <= set(FILES)


@pytest.mark.parametrize("name", FILES)
def test_numbers_of_estimators_have_names_units_and_origins(name):
    found = [str(one) for one in bare(ROOT / name)]
    assert len(found) <= OPEN.get(name, 0), "\n".join(found)
