"""The faults: kinds, and how a file is damaged, drawn by seed."""

import os
import random
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

KILLS = {
    "driver killed": signal.SIGKILL,
    "driver terminated": signal.SIGTERM,
    "worker killed": signal.SIGKILL,
    "worker terminated": signal.SIGTERM,
    "cluster killed": signal.SIGKILL,
}
"Fault -> signal, sent while the job runs."
STORAGE = {"disk full": "write", "read fails": "read", "read ends early": "read"}
"Fault of one file operation -> kind of the operation."
DAMAGE = ("truncated", "bit flipped", "deleted")
"Faults of a file."
TARGETS = ("input", "output", "unfinished output")
"Whose file is damaged: of the input, of the finished output, or of a killed run's output."


def truncate(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data))] if data else b""


def flip_bit(data: bytes, rng: random.Random) -> bytes:
    if not data:
        return b"\1"
    at = rng.randrange(len(data))
    return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]


CORRUPTIONS: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "truncated": truncate,
    "bit flipped": flip_bit,
}


@dataclass(frozen=True, kw_only=True)
class DamagedFile:
    """A damaged file, with its content before and after."""

    path: Path
    before: bytes
    after: bytes | None
    "None: deleted."

    def restore(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_bytes(self.before)

    def repeat(self) -> None:
        """Damage the file once more in the same way."""
        if self.after is None:
            self.path.unlink()
        else:
            self.path.write_bytes(self.after)


def damage_file(
    folder: Path, kind: str, rng: random.Random, ignored: tuple[str, ...] = ()
) -> DamagedFile | None:
    """Damage one random file of a folder; None if it has none, or the job deletes the file first.

    The file's time stays as it was, as with a failing disk. Files below a folder or with a name
    of `ignored` are left alone.
    """
    files = sorted(
        path
        for path in folder.rglob("*")
        if path.is_file() and not set(path.relative_to(folder).parts) & set(ignored)
    )
    if not files:
        return None
    path = rng.choice(files)
    try:
        status = path.stat()
        before = path.read_bytes()
        after = CORRUPTIONS[kind](before, rng) if kind in CORRUPTIONS else None
        if after is None:
            path.unlink()
        else:
            # In place: a process that has the file open sees the damage, and so does a hard link.
            with path.open("r+b") as stream:
                stream.write(after)
                stream.truncate()
            os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    except FileNotFoundError:
        return None
    return DamagedFile(path=path, before=before, after=after)
