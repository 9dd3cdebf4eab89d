"""Fixtures and hooks of every test."""
import gc
import os
import threading
import time
from pathlib import Path

import hypothesis
import pytest

# How long an example takes says how busy the machine is.
hypothesis.settings.register_profile(
    "untimed", deadline=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow])
hypothesis.settings.load_profile("untimed")

ROOT = Path(__file__).resolve().parent
DATA = Path(os.environ.get("PDAVIS_TEST_DATA") or "/nowhere")
DATA_WORDS = ("PDAVIS_TEST_DATA", "test data", "real data")


def pytest_collection():
    """Leave garbage alone while thousands of tests are made that stay."""
    gc.disable()


def pytest_collection_finish():
    """Look for garbage again, among what comes from now on."""
    gc.enable()
    gc.freeze()


@pytest.fixture(scope="session")
def data_dir():
    """Return the folder of real recordings; skip where there is none."""
    if not DATA.is_dir():
        pytest.skip("PDAVIS_TEST_DATA names no folder")
    return DATA


@pytest.fixture(scope="session")
def root():
    """Return the top folder of the sources."""
    return ROOT


@pytest.fixture(autouse=True)
def _no_file_stays_open():
    before = _open_files()
    yield
    left = _open_files() - before
    if left:
        gc.collect()  # a traceback may hold one until its cycle is broken
        left = _open_files() - before
    assert not left, f"left open: {sorted(path for _, path in left)}"


@pytest.fixture
def threads_ended():
    """Return a function that tells whether the package's threads of the test ended."""
    before = set(threading.enumerate())

    def ended(patience_s=0.0):
        until_s = time.monotonic() + patience_s
        while left := [thread for thread in set(threading.enumerate()) - before
                       if thread.name.startswith("pdavis")]:
            if time.monotonic() >= until_s:
                print("threads left:", left)
                return False
            time.sleep(0.05)
        return True

    return ended


def _open_files():
    """Return (descriptor, path) of each regular file that this process holds."""
    found = set()
    for number in os.listdir("/proc/self/fd") if os.path.isdir("/proc/self/fd") else ():
        try:
            path = os.readlink(f"/proc/self/fd/{number}")
        except OSError:
            continue  # the descriptor of the listing itself
        ours = not path.endswith(".ttf")      # matplotlib keeps its fonts open
        if ours and path.startswith("/") and not path.startswith(DEVICES) and (
                os.path.isfile(path)):
            found.add((number, path))
    return found


DEVICES = ("/dev/", "/proc/", "/sys/")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Turn a data test's skip into a failure where the data are there."""
    report = yield
    if report.skipped and not hasattr(report, "wasxfail") and DATA.is_dir():
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else ""
        uses_data = "data_dir" in getattr(item, "fixturenames", ())
        if uses_data or any(word in reason for word in DATA_WORDS):
            report.outcome = "failed"
            report.longrepr = f"a data test skipped though {DATA} exists: {reason}"
    return report


@pytest.fixture
def silence_tells_no_time(monkeypatch):
    """Let a dv stream's time not go on with the host's while nothing arrives.

    A test sends seconds of stream at once.  Events that a busy machine delivers later
    than their stream's time has been said to be would be dropped, as late.
    """
    monkeypatch.setattr("pdavis_cv.live.dv.MARGIN_US", 1 << 60)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Let cameras be learned from a few samples, where accuracy is not the subject.

    Tests that are marked `accuracy` learn as users do.
    """
    from pdavis_cv.fusion import learning
    from pdavis_cv.pixel import learn, rows

    whole = item.get_closest_marker("accuracy")
    for module, name, few in (
            (learn, "STARTS_US", (0,)), (learn, "MOST_SEARCHED", (150, 150)),
            (learn, "MOST_TRIED", 150), (learn, "MOST_FURTHER", 150),
            (learn, "ROUNDS", 2), (rows, "MOST_ROWS", 300)):
        usual = _USUAL.setdefault(name, getattr(module, name))
        if getattr(module, name) != (usual if whole else few):
            setattr(module, name, usual if whole else few)
            learning._kept.clear()      # of recordings that tests share


_USUAL = {}
