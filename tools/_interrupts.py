"""Ctrl-C, SIGTERM and SIGHUP raise KeyboardInterrupt, which ends every command."""
from __future__ import annotations

import _thread
import contextlib
import queue
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

_ENDING = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP")
           if hasattr(signal, name)]
RETRY_S = 0.05
"""Time until an interrupt is raised again that Python ignored, s."""


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block like Ctrl-C, and lose no interrupt.

    Python calls a signal handler between any two bytecodes, also of a destructor or of
    a weak reference's callback, whose exceptions it can only report: a
    KeyboardInterrupt raised there would be printed and forgotten.  It is raised again
    a moment later.  Modules in C that are being imported make an ImportError of it.
    """
    _came.clear()
    with contextlib.ExitStack() as stack:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, *_ENDING):
                if signal.getsignal(number) in (    # nobody else's
                        signal.SIG_DFL, signal.default_int_handler):
                    before = signal.signal(number, _raise)
                    stack.callback(signal.signal, number, before)
            stack.enter_context(_raised_again())
        try:
            yield
        except ImportError:
            if _came:
                raise KeyboardInterrupt from None
            raise


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM end the block normally, as a live source has no end."""
    before = signal.signal(signal.SIGTERM, _raise)
    try:
        yield
    except KeyboardInterrupt:
        pass
    finally:
        signal.signal(signal.SIGTERM, before)


_came: list[int] = []
"""Signals that raised KeyboardInterrupt in the block."""


def _raise(number: int, _: Any) -> NoReturn:
    _came.append(number)
    raise KeyboardInterrupt


def _interrupt() -> None:
    """Send the main thread a signal that raises KeyboardInterrupt."""
    ours = signal.getsignal(signal.SIGTERM) is _raise
    number = signal.SIGTERM if ours else signal.SIGINT
    if hasattr(signal, "pthread_kill"):  # this also ends a call that waits
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:
        _thread.interrupt_main(number)


@contextlib.contextmanager
def _raised_again() -> Iterator[None]:
    """Raise each KeyboardInterrupt again that Python ignored."""
    report, lost = sys.unraisablehook, queue.SimpleQueue[Any]()
    watcher = threading.Thread(target=_watch, args=(lost, report), daemon=True)
    watcher.start()
    # A hook without bytecode, as the next signal's handler would run between it.
    sys.unraisablehook = lost.put
    try:
        yield
    except KeyboardInterrupt as interrupt:
        import traceback  # no other end needs it
        traceback.clear_frames(interrupt.__traceback__)  # which destroys what they hold
        raise
    finally:
        sys.unraisablehook = report
        lost.put(None)
        watcher.join()      # so that it sends no signal after the block


def _watch(lost: queue.SimpleQueue[Any], report: Callable[[Any], object]) -> None:
    """Send a signal a moment after interrupts were ignored, until None is put."""
    due = False
    while True:
        try:
            ignored = lost.get(timeout=RETRY_S if due else None)
        except queue.Empty:
            due = False
            _interrupt()
            continue
        if ignored is None:
            return
        if issubclass(ignored.exc_type, KeyboardInterrupt):
            due = True
        elif not _came:     # after one, what was left half made cannot be destroyed
            report(ignored)
