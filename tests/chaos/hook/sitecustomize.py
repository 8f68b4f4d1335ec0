"""Storage faults in every Python process with this folder on its path and CHAOS set.

CHAOS names a JSON file `kind, operation, at, under, counter`. Operations ("read" or "write") on
files below the folder `under` are counted over all processes, in files beside `counter`; the
operation of number `at` meets the fault `kind`. Without the JSON file, nothing happens.

In a cluster of the tests (PVDA_TESTS_RAY_WORKERS is set, see tests/ray_workers.py), it also makes
Ray's processes cheaper to start.
"""

import errno
import fcntl
import importlib.abc
import importlib.util
import json
import os
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


def fault_of(operation: str, path: str) -> str | None:
    """The fault of this operation, or None."""
    try:
        with open(os.environ["CHAOS"]) as stream:
            fault = json.load(stream)
    except (OSError, ValueError):
        return None
    if not os.path.abspath(path).startswith(fault["under"]):
        return None
    with open(f"{fault['counter']}.{operation}", "a+") as counter:
        fcntl.flock(counter, fcntl.LOCK_EX)
        counter.write(".")
        counter.flush()
        number = counter.tell() - 1
    return str(fault["kind"]) if (operation, number) == (fault["operation"], fault["at"]) else None


class Stream:
    """A stream that fails, or ends in the middle of the file."""

    def __init__(self, stream: Any, kind: str, size: int) -> None:
        self._stream, self._kind, self._end = stream, kind, size // 2

    def _check(self) -> None:
        if self._kind == "read fails":
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    def read(self, size: int | None = -1) -> bytes:
        self._check()
        left = max(0, self._end - self._stream.tell())
        data: bytes = self._stream.read(left if size is None or size < 0 else min(size, left))
        return data

    read1 = read

    def readinto(self, buffer: Any) -> int:
        data = self.read(len(buffer))
        buffer[: len(data)] = data
        return len(data)

    def readline(self, size: int = -1) -> bytes:
        self._check()
        line: bytes = self._stream.readline(size)
        return line

    def __iter__(self) -> Iterator[bytes]:
        return iter(self.readline, b"")

    def __enter__(self) -> "Stream":
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def inject_faults(storage: Any) -> None:
    """Wrap the functions of pipeline.core.storage so that they meet the faults."""
    open_read, read_bytes, read_head, atomic_file = (
        getattr(storage, name) for name in ("open_read", "read_bytes", "read_head", "atomic_file")
    )

    def bad_bytes(path: str, read: Callable[[], bytes]) -> bytes:
        kind = fault_of("read", path)
        if kind == "read fails":
            raise OSError(errno.EIO, os.strerror(errno.EIO), path)
        data = read()
        return data[: len(data) // 2] if kind == "read ends early" else data

    def bad_open(path: str) -> Any:
        kind = fault_of("read", path)
        stream = open_read(path)
        return stream if kind is None else Stream(stream, kind, storage.size(path))

    @contextmanager
    def bad_atomic_file(path: str) -> Iterator[str]:
        kind = fault_of("write", path)
        with atomic_file(path) as local:
            yield local
            if kind == "disk full":
                os.truncate(local, os.path.getsize(local) // 2)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)

    storage.open_read, storage.atomic_file = bad_open, bad_atomic_file
    storage.read_bytes = lambda path: bad_bytes(path, lambda: read_bytes(path))
    storage.read_head = lambda path, size: bad_bytes(path, lambda: read_head(path, size))


class Finder(importlib.abc.MetaPathFinder):
    """Imports pipeline.core.storage and wraps it."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> Any:
        if name != "pipeline.core.storage":
            return None
        sys.meta_path.remove(self)
        spec: Any = importlib.util.find_spec(name)
        load = spec.loader.exec_module

        def exec_module(module: Any) -> None:
            load(module)
            inject_faults(module)

        spec.loader.exec_module = exec_module
        return spec


def hand_over(address: str) -> None:
    """Let the process above the cluster fork this worker of Ray's, see tests/ray_workers.py."""
    order = {
        "command": sys.orig_argv[1:],
        "environment": dict(os.environ),
        "folder": os.getcwd(),
        "path": sys.path,
    }
    with socket.socket(socket.AF_UNIX) as server:
        server.connect(address)
        server.sendall(json.dumps(order).encode())
    os._exit(0)


if "CHAOS" in os.environ:
    sys.meta_path.insert(0, Finder())
if "PVDA_TESTS_RAY_WORKERS" in os.environ:
    script = os.path.basename(sys.argv[0])
    if script == "default_worker.py":
        hand_over(os.environ["PVDA_TESTS_RAY_WORKERS"])
    elif script == "dashboard.py":  # each module is a process; nobody asks the others
        sys.argv.append("--modules-to-load=JobHead,NodeHead,StateHead")
