"""Ctrl-C and SIGTERM, raised until they come through.

An exception from a signal handler is raised wherever the program is at that moment. In a callback
within an import, or in C code of a library that clears errors, it is lost: one Ctrl-C in some
twenty while pyarrow looks for pandas.
"""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SECONDS_TO_REPEAT = 0.25


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

    def stop(number: int, frame: FrameType | None) -> None:
        # A pending alarm when the timer was stopped: set again it would outlive this handler.
        if stopped:
            return
        signal.setitimer(signal.ITIMER_REAL, SECONDS_TO_REPEAT)
        if number != signal.SIGALRM:
            received.append(number)
        elif _is_raising():
            return
        raise KeyboardInterrupt

    handled = [signal.SIGALRM, signal.SIGTERM]
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        handled.append(signal.SIGINT)
    before = {number: signal.signal(number, stop) for number in handled}
    try:
        yield received
    finally:
        stopped = True
        signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in before.items():
            signal.signal(number, handler)


def _is_raising() -> bool:
    """Whether a KeyboardInterrupt is being handled: its cleanup must not be interrupted."""
    error = sys.exc_info()[1]
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None
