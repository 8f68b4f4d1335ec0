"""Files damaged by seed, and what a reader has to do: name file and remedy, or read the same."""

import hashlib
import re
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.core import json_files
from pipeline.core.errors import InputError
from pipeline.shards.manifest import read_manifest

REMEDIES = re.compile(
    r"jobs/\w+\.py|embed its shard again|run the same command again|calibrate again"
    r"|taking checkpoint"
)


def damaged_versions(good: bytes, count: int, seed: int = 0) -> Iterator[bytes | None]:
    """None for a deleted file, then `count` damaged versions of its bytes."""
    rng = np.random.default_rng(seed)
    yield None
    for number in range(count):
        data, at = bytearray(good), int(rng.integers(len(good)))
        if number % 10 == 8:
            data[at : at + int(rng.integers(1, 65))] = b""
        elif number % 10 == 9:
            data = data[:at]
        else:
            for _ in range((1, 1, 1, 1, 1, 2, 4, 16)[number % 10]):
                data[at] ^= 1 << int(rng.integers(8))
                jump = rng.random() < 0.5
                at = int(rng.integers(len(good))) if jump else min(at + 1, len(good) - 1)
        yield bytes(data)


def error_message(work: Callable[[], Any], errors: type[Exception] = InputError) -> str | None:
    """The message of the error that `work` raises; None if it raises none."""
    try:
        work()
    except errors as error:
        return str(error)
    return None


def assert_unchanged(found: Any, expected: Any) -> None:
    assert found == expected, "other content, and no error"


def count_detected(
    path: Path, read: Callable[[], Any], count: int, errors: type[Exception] = InputError
) -> int:
    """Damage the file in `count` ways and delete it; the number of versions that `read` refused.

    Each refusal has to name the file and a remedy; without one, the content has to be the same.
    """
    good, expected, refused = path.read_bytes(), read(), 0
    for data in damaged_versions(good, count):
        path.unlink(missing_ok=True)
        if data is not None:
            path.write_bytes(data)
        message = error_message(lambda: assert_unchanged(read(), expected), errors)
        if message is not None:
            assert str(path) in message
            assert REMEDIES.search(message), message
            refused += 1
    path.write_bytes(good)
    assert read() == expected
    return refused


def raising_if_missing(
    path: Path, read: Callable[[], Any], error: type[Exception] = InputError
) -> Callable[[], Any]:
    """`read`, for a file whose absence means that a stage has not started: raises instead."""

    def checked() -> Any:
        if not path.exists():
            raise error(f"{path} is gone; jobs/again.py")
        return read()

    return checked


def update_checksum(shards: Path, name: str) -> None:
    """Write a tar's present hash into the manifest, as if it had been packed like this."""
    manifest = read_manifest(str(shards))
    digest = hashlib.sha256((shards / f"{name}.tar").read_bytes()).hexdigest()
    updated = tuple(
        replace(shard, sha256=digest) if shard.name == name else shard for shard in manifest.shards
    )
    json_files.write_checksummed(
        str(shards / "manifest.json"), asdict(replace(manifest, shards=updated))
    )
