"""Ctrl-C and SIGTERM: both raise KeyboardInterrupt, and it always ends the command."""
from __future__ import annotations

import _thread
import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any, NoReturn

__all__ = ["ended_by_signals", "interruptible"]

RETRY_S = 0.05
"""Time until an interrupt is raised again that Python ignored, s."""


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Let SIGTERM end the block like Ctrl-C, and lose no interrupt.

    Python calls a signal handler between any two bytecodes, also of a destructor or of
    a weak reference's callback, whose exceptions it can only report: a
    KeyboardInterrupt raised there would be printed and forgotten.  It is raised again
    a moment later.
    """
    with contextlib.ExitStack() as stack:
        if threading.current_thread() is threading.main_thread():
            if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:  # nobody else's
                before = signal.signal(signal.SIGTERM, _raise)
                stack.callback(signal.signal, signal.SIGTERM, before)
            stack.enter_context(_raised_again())
        yield


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


def _raise(*_: Any) -> NoReturn:
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
    report = sys.unraisablehook
    waiting: list[threading.Timer] = []

    def raise_again(lost: Any) -> None:
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            report(lost)
            return
        # Not from here: what is raised in this function is ignored, too.
        timer = threading.Timer(RETRY_S, _interrupt)
        timer.daemon = True
        waiting.append(timer)
        timer.start()

    sys.unraisablehook = raise_again
    try:
        yield
    finally:
        sys.unraisablehook = report
        for timer in waiting:
            timer.cancel()
