"""What a reader may do with hostile input: answer, or say no in a sentence, within bounded time and
memory.

`PVDA_FUZZ_EXAMPLES=1000` tries that many examples per test, others each time; without it there are few, always the same.
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
"That one example may take; a reader's bound times what a busy machine adds."
LONGEST_SENTENCE = 6_000
"Characters: a sentence that names a path or two."
ADDRESSES = 6 << 30
"""Bytes of address space that an example may ask for: what asks for more meets a MemoryError, and
is found out."""


def examples(quick: int, share: float = 1.0) -> settings:
    """Few fixed examples in a normal run; in a long one `share` of PVDA_FUZZ_EXAMPLES, for tests
    that are slow.
    """
    return settings(
        max_examples=max(1, round(EXAMPLES * share)) if EXAMPLES else quick,
        derandomize=not EXAMPLES,
        database=None,
        deadline=None,  # `bounded` stops what takes too long while it runs
        suppress_health_check=list(HealthCheck),
        print_blob=True,
    )


class TooLong(BaseException):
    """Of no kind that a reader may catch."""


@contextmanager
def bounded(
    *refusals: type[Exception], seconds: float = SECONDS, megabytes: float = MEGABYTES
) -> Iterator[None]:
    """Run the block: it may raise `refusals` with a sentence; anything else, and whatever takes too
    much, fails the test.
    """
    held, peak = resource.getrlimit(resource.RLIMIT_AS), _peak()
    with open("/proc/self/statm") as stream:
        mapped = int(stream.read().split()[0]) * resource.getpagesize()
    before = signal.signal(signal.SIGALRM, _stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    resource.setrlimit(resource.RLIMIT_AS, (mapped + ADDRESSES, held[1]))
    try:
        yield
    except refusals as error:
        told = str(error).strip()
        assert told, "an error without a word"  # any of several exceptions
        if isinstance(error, InputError):  # others become a Rejection, which cuts them
            assert len(told) <= LONGEST_SENTENCE, f"a sentence of {len(told)} characters"
    finally:
        resource.setrlimit(resource.RLIMIT_AS, held)
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert _peak() - peak <= megabytes, f"{_peak() - peak:.0f} MB, expected at most {megabytes:.0f}"


def _stop(number: int, frame: FrameType | None) -> None:
    raise TooLong


def _peak() -> float:
    """Most memory that this process has had so far, megabytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
