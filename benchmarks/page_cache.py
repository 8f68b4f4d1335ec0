"""Drops files from the page cache, so that what reads them next waits for the disk."""

import ctypes
import mmap
import os
from collections.abc import Sequence
from pathlib import Path

LIBC = ctypes.CDLL(None, use_errno=True)


def drop_from_cache(*folders: str) -> None:
    """Write the files of folders back and drop them from the page cache, also those that this
    process has mapped: it keeps its mappings, and reads them from the disk.
    """
    for begin, end in _mapped(folders):
        # What a process has mapped stays in the cache until it lets go.
        address, size = ctypes.c_void_p(begin), ctypes.c_size_t(end - begin)
        if LIBC.madvise(address, size, mmap.MADV_DONTNEED):
            raise OSError(ctypes.get_errno(), "madvise")
    for folder in folders:
        for path in Path(folder).rglob("*"):
            if path.is_file():
                descriptor = os.open(path, os.O_RDONLY)
                os.fdatasync(descriptor)
                os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
                os.close(descriptor)


def _mapped(folders: Sequence[str]) -> list[tuple[int, int]]:
    """First address and end of what this process has mapped of files in folders."""
    roots = tuple(f"{Path(folder).resolve()}/" for folder in folders)
    found = []
    for line in Path("/proc/self/maps").read_text().splitlines():
        words = line.split(maxsplit=5)
        if len(words) == 6 and words[5].startswith(roots) and words[1].startswith("r--"):
            begin, end = (int(address, 16) for address in words[0].split("-"))
            found.append((begin, end))
    return found
