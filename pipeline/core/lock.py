"""One run at a time writes a folder: a second one on the same output is refused while the first
lives.

The lock is the operating system's, on a file of this machine's temporary folder that is named after
the output: it goes with the process that holds it, however that ends, so nothing has to be cleaned
up after a kill and nothing stands beside the output. Runs on other machines are not seen, nor is
what object stores hold; there, files that appear whole and have the same content whoever writes
them are all the protection there is.
"""

import fcntl
import hashlib
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import ParamSpec, TypeVar

from pipeline.core import storage
from pipeline.core.errors import InputError

Given = ParamSpec("Given")
Made = TypeVar("Made")


@contextmanager
def output_lock(out: str) -> Iterator[None]:
    """Hold the folder `out` as the one run that writes it.

    Raises InputError, which says who, where another run holds it.
    """
    if not storage.is_local(out):
        yield
        return
    name = hashlib.sha256(
        os.path.realpath(storage.resolve(out)[1]).encode("utf-8", "surrogateescape")
    ).hexdigest()
    folder = os.path.join(tempfile.gettempdir(), f"pvda-locks-{os.getuid()}")
    os.makedirs(folder, mode=0o700, exist_ok=True)
    file = os.open(os.path.join(folder, name), os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(file, 200, 0).decode(errors="replace") or "another process"
            raise InputError(
                f"{out} is being written by {holder}; expected one run at a time; wait until it has ended, or choose another "
                "--out"
            ) from None
        os.ftruncate(file, 0)
        os.pwrite(file, f"process {os.getpid()}, since {time.strftime('%F %T')}".encode(), 0)
        yield
    finally:
        os.close(file)


def locks_output(
    out: Callable[Given, str],
) -> Callable[[Callable[Given, Made]], Callable[Given, Made]]:
    """Make a stage the only run that writes its output; `out` says which, of the stage's arguments."""

    def of(stage: Callable[Given, Made]) -> Callable[Given, Made]:
        @wraps(stage)
        def alone(*args: Given.args, **kwargs: Given.kwargs) -> Made:
            with output_lock(out(*args, **kwargs)):
                return stage(*args, **kwargs)

        return alone

    return of
