"""Files on any storage that fsspec knows: a plain path, file://, s3://, gs://, memory://. Writing
is atomic."""

import json
import os
import re
import tempfile
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import fsspec
from fsspec.implementations.local import LocalFileSystem

from pipeline.core.errors import InputError

TEMPORARY_NAME = re.compile(r"\.(.+)\.[0-9a-f]{8}")
"Names that `atomic_file` gives to files until they are complete."


def resolve(path: str) -> tuple[Any, str]:
    """The fsspec file system of a path, and the path on it.

    Raises InputError if no file system is known by a URI's scheme, or its package is not installed.
    """
    if "://" not in path:  # to fsspec a name with :: in it would be a chain of file systems
        local = LocalFileSystem()
        return local, local._strip_protocol(path)
    try:
        filesystem, inner = fsspec.core.url_to_fs(path)
    except (ValueError, ImportError) as error:
        raise InputError(
            f"{path} is on no storage that is known here ({error}); expected a path, file://, "
            "s3:// or gs://"
        ) from None
    return filesystem, inner


def is_local(path: str) -> bool:
    return isinstance(resolve(path)[0], LocalFileSystem)


def absolute(path: str) -> str:
    """The path as a process with another working directory must name it; URIs stay as they are."""
    return path if "://" in path else os.path.abspath(os.path.expanduser(path))


def join(folder: str, *names: str) -> str:
    return "/".join([folder.rstrip("/"), *names])


def beside(folder: str, ending: str) -> str:
    """The path of a file next to a folder and named after it, where no reader of the folder looks.

    Raises InputError where the folder is the root of its storage, which has nothing beside it.
    """
    path = absolute(folder)
    if "/" not in resolve(path)[1].rstrip("/"):
        raise InputError(
            f"{folder} is the root of its storage, expected a folder in it; name one below it"
        )
    return path.rstrip("/") + ending


def exists(path: str) -> bool:
    filesystem, inner = resolve(path)
    return bool(filesystem.exists(inner))


def list_names(folder: str) -> list[str]:
    """File names in a folder, sorted, without hidden and temporary ones; none if it is absent."""
    filesystem, inner = resolve(folder)
    if not filesystem.isdir(inner):
        return []
    found = (entry.rstrip("/").rsplit("/", 1)[-1] for entry in filesystem.ls(inner, detail=False))
    return sorted(name for name in found if not name.startswith("."))


def walk(folder: str) -> dict[str, int]:
    """Paths, relative to the folder, of all files below it, sorted, with their sizes in bytes;
    hidden ones left out.

    Links are followed, but not in circles.
    """
    filesystem, inner = resolve(folder)
    root = inner.rstrip("/") + "/"
    if isinstance(filesystem, LocalFileSystem):
        found = dict(_walk_disk(inner, frozenset()))
    else:
        entries = filesystem.find(inner, detail=True).items()
        found = {path: entry["size"] for path, entry in entries}
    below = sorted((path.removeprefix(root), size) for path, size in found.items())
    return {path: size for path, size in below if not _is_hidden(path)}


def _is_hidden(path: str) -> bool:
    return any(part.startswith(".") for part in path.split("/"))


def _walk_disk(folder: str, above: frozenset[str]) -> Iterator[tuple[str, int]]:
    """All files below a folder of this machine; links whose target is gone have size 0. `above`:
    the folders on the way."""
    real = os.path.realpath(folder)
    if real in above:
        return
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir():
                yield from _walk_disk(entry.path, above | {real})
            else:
                yield entry.path, entry.stat().st_size if entry.is_file() else 0


def is_folder(path: str) -> bool:
    filesystem, inner = resolve(path)
    return bool(filesystem.isdir(inner))


def is_file(path: str) -> bool:
    return exists(path) and not is_folder(path)


def size(path: str) -> int:
    """Bytes of a file."""
    filesystem, inner = resolve(path)
    return int(filesystem.size(inner))


def read_bytes(path: str) -> bytes:
    filesystem, inner = resolve(path)
    data: bytes = filesystem.cat_file(inner)
    return data


def read_head(path: str, size: int) -> bytes:
    """The first `size` bytes of a file, or all of a shorter one; no more is fetched from a remote
    file."""
    filesystem, inner = resolve(path)
    data: bytes = filesystem.cat_file(inner, start=0, end=size)
    return data


def read_json(path: str) -> Any:
    """Raises ValueError if the file is not JSON, or nested deeper than anything written here."""
    try:
        return json.loads(read_bytes(path))
    except RecursionError:
        raise ValueError("lists within lists without end") from None


def open_read(path: str) -> IO[bytes]:
    filesystem, inner = resolve(path)
    stream: IO[bytes] = filesystem.open(inner, "rb")
    return stream


@contextmanager
def atomic_write(path: str) -> Iterator[IO[bytes]]:
    """A stream to write a file through, which appears under its name when complete or never."""
    with atomic_file(path) as local, open(local, "wb") as stream:
        yield stream


@contextmanager
def atomic_file(path: str) -> Iterator[str]:
    """A local path to write a file to, which appears under its own name when complete or not at
    all.

    On a local disk: a hidden temporary neighbour, fsynced and renamed. Elsewhere: one upload at the
    end, which object stores make visible at once.
    """
    filesystem, inner = resolve(path)
    if not isinstance(filesystem, LocalFileSystem):
        filesystem.makedirs(inner.rsplit("/", 1)[0], exist_ok=True)
        with tempfile.TemporaryDirectory() as scratch:
            local = os.path.join(scratch, "file")
            yield local
            filesystem.put_file(local, inner)
        return
    target = Path(inner)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}")
    try:
        yield str(temporary)
        with temporary.open("rb") as written:
            os.fsync(written.fileno())
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def remove_temporaries(folder: str, names: Iterable[str]) -> None:
    """Remove the temporary files that a killed process left of these files in a folder. Nothing may
    be writing them meanwhile."""
    filesystem, inner = resolve(folder)
    if isinstance(filesystem, LocalFileSystem) and os.path.isdir(inner):
        wanted = set(names)
        for entry in os.listdir(inner):
            match = TEMPORARY_NAME.fullmatch(entry)
            if match and match[1] in wanted:
                Path(inner, entry).unlink(missing_ok=True)


def link_or_copy(source: str, target: str) -> None:
    """A second name for a file's content on the same storage, atomically; later writes to either
    must be atomic too.

    On a local disk a hard link, which costs nothing, if the disk has them.
    """
    filesystem, inner = resolve(source)
    other = resolve(target)[1]
    if not isinstance(filesystem, LocalFileSystem):
        filesystem.copy(inner, other)
        return
    temporary = Path(other).with_name(f".{Path(other).name}.{uuid.uuid4().hex[:8]}")
    try:
        os.link(inner, temporary)
    except OSError:
        write_bytes(target, read_bytes(source))
    else:
        temporary.replace(other)
    finally:
        temporary.unlink(missing_ok=True)


def make_folder(path: str) -> None:
    """Make a folder of this machine where there is none; other storages have no empty folders."""
    filesystem, inner = resolve(path)
    if isinstance(filesystem, LocalFileSystem):
        os.makedirs(inner, exist_ok=True)


def remove(path: str) -> None:
    filesystem, inner = resolve(path)
    filesystem.rm_file(inner)


def remove_folder(path: str) -> None:
    """Remove a folder with all its content; an absent one is no error."""
    filesystem, inner = resolve(path)
    if filesystem.exists(inner):
        filesystem.rm(inner, recursive=True)


def write_bytes(path: str, data: bytes) -> None:
    with atomic_write(path) as stream:
        stream.write(data)


def encode_json(value: Any) -> bytes:
    """The bytes that `write_json` writes."""
    return (json.dumps(value, indent=2, ensure_ascii=False) + "\n").encode()


def write_json(path: str, value: Any) -> None:
    write_bytes(path, encode_json(value))
