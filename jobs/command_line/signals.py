"""Ctrl-C and SIGTERM, raised until they are heard.

An exception that a signal's handler raises comes up wherever the program happens to be. Where that
is a callback within an import, or a library's C code that clears errors, it is dropped: one Ctrl-C
in some twenty while pyarrow looks for pandas.
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

    Outside the main thread, where Python hears no signals, nothing is changed, and a SIGINT that
    the caller's shell has it ignore is left ignored.
    """
    received: list[
        int
    ] = []  # Ray makes a plain KeyboardInterrupt of whatever a handler raises while it waits
    if threading.current_thread() is not threading.main_thread():
        yield received
        return

    over = False

    def stop(number: int, frame: FrameType | None) -> None:
        # an alarm that was on its way when the timer was stopped: set again it would outlive this
        # handler
        if over:
            return
        signal.setitimer(signal.ITIMER_REAL, SECONDS_TO_REPEAT)
        if number != signal.SIGALRM:
            received.append(number)
        elif _is_raising():
            return
        raise KeyboardInterrupt

    heard = [signal.SIGALRM, signal.SIGTERM]
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        heard.append(signal.SIGINT)
    before = {number: signal.signal(number, stop) for number in heard}
    try:
        yield received
    finally:
        over = True
        signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in before.items():
            signal.signal(number, handler)


def _is_raising() -> bool:
    """Whether a KeyboardInterrupt is being handled: what tidies up after it is not to be
    interrupted.
    """
    error = sys.exc_info()[1]
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None
