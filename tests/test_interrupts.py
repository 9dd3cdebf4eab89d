"""Ctrl-C and SIGTERM end a command with one line, whatever it is doing."""
import os
import signal
import subprocess
import sys
import time
import weakref
from concurrent.futures import ProcessPoolExecutor

import pytest

from pdavis_cv.batch.processes import ProcessPool
from pdavis_cv.data import example_recording
from pdavis_cv.recording import sandbox
from pdavis_cv.tools import _interrupts
from pdavis_cv.tools._common import command

pytestmark = pytest.mark.skipif(os.name != "posix", reason="sends signals")


@pytest.mark.parametrize("command", [
    ["export", "-o", "x.mp4"], ["export", "-o", "x.ome.tif"], ["fan", "-o", "x.mp4"],
    ["tendon", "-o", "."]])
def test_an_interrupted_process_says_one_line_and_leaves_nothing(tmp_path, command):
    if "tendon" in command:
        pytest.importorskip("matplotlib")
    tool, *options = command
    # Jobs in the background are started deaf to SIGINT.  The first image imports Cython
    # modules, numpy.random among them, whose start ignores what abc.register raises: an
    # interrupt at that moment would be lost.
    program = (
        "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from pdavis_cv.fusion import Fusion\nfrom pdavis_cv.tools import main\n"
        "following, told = Fusion.advance, []\n"
        "def tell(self):\n"
        "    if self.index and not told:\n"
        "        told.append(print('works', flush=True))\n"
        "    return following(self)\n"
        "Fusion.advance = tell\nraise SystemExit(main.main())")
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", program, tool,
         str(example_recording()), *options, "--fps", "30000", "--layout", "pdavis",
         "--method", "cf"],
        cwd=tmp_path, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "works\n"
    # Where a file grows, the first image is in it; tendon writes when all is measured.
    deadline = time.monotonic() + 60
    while not any(tmp_path.iterdir()) and "tendon" not in command:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert error == "pdavis: interrupted; nothing unfinished was left\n"
    assert out == ""
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize("module", ["numpy", "numpy.linalg", "pdavis_cv._kernels"])
def test_an_interrupt_while_modules_load_says_one_line(tmp_path, module, lost):
    program = (  # jobs in the background are started deaf to SIGINT
        "import os, signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "class Interrupt:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {module!r}:\n"
        "            try: os.kill(os.getpid(), signal.SIGINT)\n"
        "            except KeyboardInterrupt:\n"
        f"                if {lost}: raise ImportError('as modules in C') from None\n"
        "                raise\n"
        "from pdavis_cv.tools.main import main\n"
        "sys.meta_path.insert(0, Interrupt())\n"
        "raise SystemExit(main())")
    run = subprocess.run(
        [sys.executable, "-P", "-c", program, "export", str(example_recording()),
         "-o", "x.mp4"], cwd=tmp_path, capture_output=True, text=True, timeout=60,
        check=False)
    assert (run.returncode, run.stdout) == (130, "")
    assert run.stderr == "pdavis: interrupted; nothing unfinished was left\n"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("starts", [
    pytest.param(
        "from pdavis_cv.batch.processes import ProcessPool\n"
        "    with ProcessPool(2) as pool: print(pool.submit(abs, -1).result())",
        id="pool"),
    pytest.param(
        "from pdavis_cv import open_recording\n"
        "    with open_recording(sys.argv[1], isolated=True): print(1)", id="isolated",
        marks=pytest.mark.skipif(not sandbox.available(), reason="Linux 5.13"))])
def test_an_interrupt_is_not_for_processes_that_begin(tmp_path, starts):
    # What sitecustomize does comes before all else that a process does.
    (tmp_path / "sitecustomize.py").write_text(
        "import os, signal\n"
        "if 'BEGUN' in os.environ: os.kill(os.getpid(), signal.SIGINT)\n")
    (tmp_path / "starts.py").write_text(
        "import os, signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"if __name__ == '__main__':\n    os.environ['BEGUN'] = '1'\n    {starts}\n")
    run = subprocess.run(
        [sys.executable, "-P", str(tmp_path / "starts.py"), str(example_recording())],
        env={**os.environ, "PYTHONPATH": str(tmp_path)}, capture_output=True, text=True,
        timeout=60, check=False)
    assert (run.returncode, run.stdout, run.stderr) == (0, "1\n", "")


class Destroyed:
    """An object that sends a signal to this process when it is destroyed."""

    def __init__(self, number):
        self.number = number

    def __del__(self):
        sent(self.number)


def sent(number):
    os.kill(os.getpid(), number)
    for _ in range(1000):  # Python calls the handler between two of these
        pass


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("times", [1, 20])
def test_an_interrupt_that_a_destructor_ignores_is_raised_again(
        capsys, monkeypatch, number, times):
    monkeypatch.setattr(sys, "unraisablehook", lambda lost: pytest.fail(str(lost)))
    # At once: while the next one is ignored, where it must not be lost either.
    monkeypatch.setattr(_interrupts, "RETRY_S", 0)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    @command
    def main(argv=None):
        kept = []
        for _ in range(times):
            Destroyed(number)
            referred = type("Referred", (), {})()
            kept.append(weakref.ref(referred, lambda _: sent(number)))
            del referred
        for _ in range(1000):   # a signal just before a wait does not end it
            time.sleep(0.01)
        return 0

    try:
        assert main([]) == 130
    finally:
        signal.signal(signal.SIGINT, before)
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["pdavis: interrupted; nothing unfinished was left"]


def test_what_an_interrupt_leaves_half_made_is_not_reported(capsys, monkeypatch):
    """As bars of tqdm 4.65 are, which cannot be destroyed."""
    reported = []
    monkeypatch.setattr(sys, "unraisablehook", reported.append)

    class HalfMade:
        def __init__(self):
            sent(signal.SIGTERM)
            self.whole = True

        def __del__(self):
            assert self.whole

    @command
    def main(argv=None):
        HalfMade()
        return 0

    assert main([]) == 130
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["pdavis: interrupted; nothing unfinished was left"]
    assert not reported


def test_what_is_ignored_besides_interrupts_is_reported_as_before(monkeypatch):
    reported = []
    monkeypatch.setattr(sys, "unraisablehook", reported.append)

    class Faulty:
        def __del__(self):
            raise ValueError("not an interrupt")

    @command
    def main(argv=None):
        Faulty()
        return 0

    assert main([]) == 0
    assert [str(lost.exc_value) for lost in reported] == ["not an interrupt"]


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="of POSIX")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_the_end_of_a_terminal_is_an_interrupt_and_ignored_ones_stay(name):
    number = getattr(signal, name)
    before = signal.signal(number, signal.SIG_DFL)
    try:
        with pytest.raises(KeyboardInterrupt), _interrupts.interruptible():
            os.kill(os.getpid(), number)
        assert signal.getsignal(number) is signal.SIG_DFL
        signal.signal(number, signal.SIG_IGN)       # nohup
        with _interrupts.interruptible():
            signal.raise_signal(number)
    finally:
        signal.signal(number, before)


def test_an_interrupt_waits_until_the_processes_of_a_pool_have_begun(monkeypatch):
    begun = []

    def slow(self, *call):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.2)
        begun.append(call)

    monkeypatch.setattr(ProcessPoolExecutor, "submit", slow)
    before = signal.signal(signal.SIGTERM, _interrupts._raise)
    try:
        with ProcessPool(1) as pool, pytest.raises(KeyboardInterrupt):
            pool.submit(len, ())
    finally:
        signal.signal(signal.SIGTERM, before)
    assert begun == [(len, ())]
