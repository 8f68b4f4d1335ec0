"""The faults: what goes wrong, drawn by seed, and when."""

import os
import random
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

KILLS = {
    "driver killed": signal.SIGKILL, "driver terminated": signal.SIGTERM,
    "worker killed": signal.SIGKILL, "worker terminated": signal.SIGTERM,
    "cluster killed": signal.SIGKILL,
}  # fmt: skip
"While the job runs."
STORAGE = {"disk full": "write", "read fails": "read", "read ends early": "read"}
"One operation on a file, and of which kind."
DAMAGE = ("truncated", "bit flipped", "deleted")
"Of a file."
PLACES = ("input", "output", "unfinished output")
"Whose file: what the job reads, what it has finished, what it had when it was killed."


def truncated(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data))] if data else b""


def bit_flipped(data: bytes, rng: random.Random) -> bytes:
    if not data:
        return b"\1"
    at = rng.randrange(len(data))
    return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]


SPOIL: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "truncated": truncated,
    "bit flipped": bit_flipped,
}


@dataclass(frozen=True, kw_only=True)
class Damaged:
    """A file that was spoilt, and what it was."""

    path: Path
    before: bytes
    after: bytes | None
    "None: deleted."

    def restore(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_bytes(self.before)

    def repeat(self) -> None:
        """Spoil it once more in the same way."""
        if self.after is None:
            self.path.unlink()
        else:
            self.path.write_bytes(self.after)


def damage(
    folder: Path, kind: str, rng: random.Random, passed_over: tuple[str, ...] = ()
) -> Damaged | None:
    """Spoil one file of a folder; None where it has none. Its time is kept, as a failing disk
    would.
    """
    files = sorted(
        path
        for path in folder.rglob("*")
        if path.is_file()
        and not any(part in passed_over for part in path.relative_to(folder).parts)
    )
    if not files:
        return None
    path = rng.choice(files)
    try:
        there = path.stat()
        before = path.read_bytes()
        after = SPOIL[kind](before, rng) if kind in SPOIL else None
        if after is None:
            path.unlink()
        else:
            # In place: whoever has the file open sees it, and a second name of it is spoilt too.
            with path.open("r+b") as stream:
                stream.write(after)
                stream.truncate()
            os.utime(path, ns=(there.st_atime_ns, there.st_mtime_ns))
    except FileNotFoundError:  # the job was quicker
        return None
    return Damaged(path=path, before=before, after=after)
