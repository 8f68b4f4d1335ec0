"""SIGINT and SIGTERM come through as KeyboardInterrupt, and leave nothing behind."""

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from types import FrameType
from typing import Any

import pytest

from jobs.command_line.signals import IMPORT_SYSTEM, LOCKING, SECONDS_TO_REPEAT, interruptible


@pytest.fixture(autouse=True)
def _hearing_ctrl_c() -> Iterator[None]:
    """What runs in a shell's background has Ctrl-C ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_signal_dropped_by_a_library_is_raised_again() -> None:
    with pytest.raises(KeyboardInterrupt), interruptible() as received:  # noqa: PT012
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        time.sleep(20)
    assert received == [signal.SIGTERM]


def test_signal_does_not_interrupt_cleanup() -> None:
    tidy = False
    with pytest.raises(KeyboardInterrupt), interruptible():  # noqa: PT012
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            with suppress(OSError):
                time.sleep(3 * SECONDS_TO_REPEAT)
            tidy = True
    assert tidy


def test_alarm_at_the_end_does_not_set_the_timer_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    set_timer = signal.setitimer

    def set_late(timer: int, seconds: float) -> None:
        set_timer(timer, seconds)
        if not seconds:
            signal.raise_signal(signal.SIGALRM)

    monkeypatch.setattr(signal, "setitimer", set_late)
    before = signal.getsignal(signal.SIGALRM)
    with pytest.raises(KeyboardInterrupt), interruptible():
        signal.raise_signal(signal.SIGTERM)
    left = set_timer(signal.ITIMER_REAL, 0)  # else it would end the tests
    assert left == (0, 0)
    assert signal.getsignal(signal.SIGALRM) is before


def test_signal_within_the_import_system_waits_for_its_end() -> None:
    """Its callbacks would print the exception and lose it."""
    reached = list[str]()
    raising = "signal.raise_signal(signal.SIGTERM)\nreached.append('end')"
    with pytest.raises(KeyboardInterrupt), interruptible() as received:  # noqa: PT012
        exec(compile(raising, IMPORT_SYSTEM, "exec"), {"signal": signal, "reached": reached})
        time.sleep(20)
    assert reached == ["end"]
    assert received == [signal.SIGTERM]


def test_signal_within_an_executor_leaves_no_lock_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jobs.command_line.signals.SECONDS_TO_REPEAT", 0.001)
    line, interrupted = 0, True

    def at_line(number: int) -> Callable[[FrameType, str, object], Any]:
        """A trace function that sends SIGTERM before a line of the standard library's threads."""
        left = [number]

        def trace(frame: FrameType, event: str, argument: object) -> Any:
            if frame.f_code.co_filename not in LOCKING:
                return None
            left[0] -= event == "line"
            if left[0] == 0:
                sys.settrace(None)
                signal.raise_signal(signal.SIGTERM)
            return trace

        return trace

    while interrupted:
        line += 1
        pool = ThreadPoolExecutor(1)
        try:
            with interruptible() as received:
                sys.settrace(at_line(line))
                pool.submit(time.monotonic).result()
                pool.submit(time.monotonic).result()
                sys.settrace(None)
                interrupted = bool(received)
                time.sleep(1.0 if interrupted else 0.0)
                assert not interrupted
        except KeyboardInterrupt:
            pass
        finally:
            sys.settrace(None)
        ending = threading.Thread(target=pool.shutdown, daemon=True)
        ending.start()
        ending.join(20)
        assert not ending.is_alive(), f"the executor cannot end after a signal at line {line}"
    assert line > 20
