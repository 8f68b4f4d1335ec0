"""Bounds of readers on hostile input: an answer or one sentence, in bounded time and memory.

`PVDA_FUZZ_EXAMPLES=1000` tries that many examples per test, different ones each time; without it
the examples are few and always the same.
"""

import os
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from hypothesis import HealthCheck, settings

from pipeline.core.errors import InputError

EXAMPLES = int(os.environ.get("PVDA_FUZZ_EXAMPLES", "0"))
SECONDS, MEGABYTES = 10, 400
"Bounds of one example: a reader's own bound times the delay of a busy machine."
MAX_MESSAGE = 6_000
"Longest message in characters: a sentence that names a path or two."
ADDRESSES = 6 << 30
"""Bytes of address space per example: a larger request meets a MemoryError, and fails the test."""


def examples(quick: int, share: float = 1.0) -> settings:
    """Few fixed examples in a normal run, `share` of PVDA_FUZZ_EXAMPLES in a long one."""
    return settings(
        max_examples=max(1, round(EXAMPLES * share)) if EXAMPLES else quick,
        derandomize=not EXAMPLES,
        database=None,
        deadline=None,  # `bounded` stops an example that takes too long
        suppress_health_check=list(HealthCheck),
        print_blob=True,
    )


class TooLong(BaseException):
    """Raised by the alarm; no reader catches BaseException."""


@contextmanager
def bounded(
    *refusals: type[Exception], seconds: float = SECONDS, megabytes: float = MEGABYTES
) -> Iterator[None]:
    """Run the block within the bounds: it may raise `refusals` with a sentence, nothing else."""
    limits, peak = resource.getrlimit(resource.RLIMIT_AS), _peak()
    with open("/proc/self/statm") as stream:
        mapped = int(stream.read().split()[0]) * resource.getpagesize()
    before = signal.signal(signal.SIGALRM, _stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    resource.setrlimit(resource.RLIMIT_AS, (mapped + ADDRESSES, limits[1]))
    try:
        yield
    except refusals as error:
        message = str(error).strip()
        assert message, "an error without a message"  # any of several exceptions
        if isinstance(error, InputError):  # others become a Rejection, which shortens them
            assert len(message) <= MAX_MESSAGE, f"a sentence of {len(message)} characters"
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert _peak() - peak <= megabytes, f"{_peak() - peak:.0f} MB, expected at most {megabytes:.0f}"


def _stop(number: int, frame: FrameType | None) -> None:
    raise TooLong


def _peak() -> float:
    """Peak memory of this process so far, megabytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
