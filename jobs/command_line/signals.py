"""Ctrl-C and SIGTERM, raised until they come through.

An exception from a signal handler is raised wherever the program is at that moment. In a callback
within an import, or in C code of a library that clears errors, it is lost: one Ctrl-C in some
twenty while pyarrow looks for pandas. Between the taking of a lock and its `with` block, it leaves
the lock taken for good: a thread of an executor then waits for it forever, and so does the program
for that thread.
"""

import queue
import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import _base, thread
from contextlib import contextmanager
from types import CodeType, FrameType

SECONDS_TO_REPEAT = 0.25
LOCKING = frozenset(str(module.__file__) for module in (_base, queue, thread, threading))
"Files of the standard library whose functions take locks, most of them for a moment."
IMPORT_SYSTEM = "<frozen importlib._bootstrap>"
"""The file of the frames of Python's import system, among them callbacks of weak references, where
an exception is printed and lost."""


@contextmanager
def interruptible() -> Iterator[list[int]]:
    """Raise KeyboardInterrupt here on SIGINT and SIGTERM, again and again until it comes through;
    the numbers received.

    Outside the main thread, where Python handles no signals, nothing is changed, and a SIGINT that
    the calling shell ignores stays ignored.
    """
    # Ray turns any exception of a handler into a plain KeyboardInterrupt while it waits.
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return

    stopped = False
    locking_at: tuple[CodeType, int] | None = None

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal locking_at
        # A pending alarm when the timer was stopped: set again it would outlive this handler.
        if stopped:
            return
        signal.setitimer(signal.ITIMER_REAL, SECONDS_TO_REPEAT)
        if number != signal.SIGALRM:
            received.append(number)
        elif _is_raising():
            return
        before, locking_at = locking_at, _locking_at(frame)
        # Still there at the alarm: it waits, which an exception does not harm.
        if locking_at is None or locking_at == before:
            raise KeyboardInterrupt

    handled = [signal.SIGALRM, signal.SIGTERM]
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        handled.append(signal.SIGINT)
    replaced = {number: signal.signal(number, stop) for number in handled}
    try:
        yield received
    finally:
        stopped = True
        signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in replaced.items():
            signal.signal(number, handler)


def _is_raising() -> bool:
    """Whether a KeyboardInterrupt is being handled: its cleanup must not be interrupted."""
    error = sys.exc_info()[1]
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None


def _locking_at(frame: FrameType | None) -> tuple[CodeType, int] | None:
    """The instruction of the standard library that may be taking a lock just now, or of the import
    system itself (a module that it is executing may be interrupted)."""
    if frame is not None and frame.f_code.co_filename == IMPORT_SYSTEM:
        return frame.f_code, frame.f_lasti
    while frame is not None and frame.f_code.co_filename not in LOCKING:
        frame = frame.f_back
    return None if frame is None else (frame.f_code, frame.f_lasti)
