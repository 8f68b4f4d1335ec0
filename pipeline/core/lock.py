"""An output lock: one run at a time writes a folder; a second run on the same output is refused.

The lock is the operating system's (`flock`), on a file in this machine's temporary folder that is
named after the output. It is released when the process that holds it ends, however that happens, so
nothing has to be cleaned up after a kill and nothing lies beside the output. Runs on other machines
are not seen, and object stores have no locks: there, the only protection is that files are written
atomically and have the same content whichever run writes them.
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

P = ParamSpec("P")
R = TypeVar("R")


@contextmanager
def output_lock(out: str) -> Iterator[None]:
    """Hold the lock of the folder `out` while the block runs.

    Raises InputError that names the holder if another run holds it.
    """
    if not storage.is_local(out):
        yield
        return
    real = os.path.realpath(storage.resolve(out)[1])
    name = hashlib.sha256(real.encode("utf-8", "surrogateescape")).hexdigest()
    folder = os.path.join(tempfile.gettempdir(), f"pvda-locks-{os.getuid()}")
    os.makedirs(folder, mode=0o700, exist_ok=True)
    file = os.open(os.path.join(folder, name), os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(file, 200, 0).decode(errors="replace") or "another process"
            raise InputError(
                f"{out} is being written by {holder}; expected one run at a time; wait until it "
                "has ended, or choose another --out"
            ) from None
        os.ftruncate(file, 0)
        os.pwrite(file, f"process {os.getpid()}, since {time.strftime('%F %T')}".encode(), 0)
        yield
    finally:
        os.close(file)


def locks_output(out: Callable[P, str]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorate a stage to hold the lock of its output, which `out` finds in its arguments."""

    def decorate(stage: Callable[P, R]) -> Callable[P, R]:
        @wraps(stage)
        def locked(*args: P.args, **kwargs: P.kwargs) -> R:
            with output_lock(out(*args, **kwargs)):
                return stage(*args, **kwargs)

        return locked

    return decorate
