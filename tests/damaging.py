"""Files damaged in seeded ways, and the verdict on who reads them: a sentence naming file and
remedy, or the same content.
"""

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

MENDS = re.compile(
    r"jobs/\w+\.py|embed its shard again|run the same command again|calibrate again|taking checkpoint"
)


def damages(good: bytes, count: int, seed: int = 0) -> Iterator[bytes | None]:
    """The file with as many damages, one at a time; None: it is gone."""
    rng = np.random.default_rng(seed)
    yield None
    for number in range(count):
        data, place = bytearray(good), int(rng.integers(len(good)))
        if number % 10 == 8:
            data[place : place + int(rng.integers(1, 65))] = b""
        elif number % 10 == 9:
            data = data[:place]
        else:
            for _ in range((1, 1, 1, 1, 1, 2, 4, 16)[number % 10]):
                data[place] ^= 1 << int(rng.integers(8))
                place = (
                    int(rng.integers(len(good)))
                    if rng.random() < 0.5
                    else min(place + 1, len(good) - 1)
                )
        yield bytes(data)


def sentence_of(work: Callable[[], Any], errors: type[Exception] = InputError) -> str | None:
    """What it is refused with, None where it is not."""
    try:
        work()
    except errors as error:
        return str(error)
    return None


def unchanged(found: Any, expected: Any) -> None:
    assert found == expected, "other content, and not a word"


def found_or_equal(
    path: Path, look: Callable[[], Any], count: int, errors: type[Exception] = InputError
) -> int:
    """Damage the file in so many ways; returns how many were refused, each naming it and what mends
    it.
    """
    good, expected, refused = path.read_bytes(), look(), 0
    for data in damages(good, count):
        path.unlink(missing_ok=True)
        if data is not None:
            path.write_bytes(data)
        said = sentence_of(lambda: unchanged(look(), expected), errors)
        if said is not None:
            assert str(path) in said
            assert MENDS.search(said), said
            refused += 1
    path.write_bytes(good)
    assert look() == expected
    return refused


def look_or_say_gone(
    path: Path, look: Callable[[], Any], error: type[Exception] = InputError
) -> Callable[[], Any]:
    """`look`, of a file whose absence means that nothing was done yet."""

    def looked() -> Any:
        if not path.exists():
            raise error(f"{path} is gone; jobs/again.py")
        return look()

    return looked


def say_again(shards: Path, name: str) -> None:
    """Have the manifest say what a tar is now, as if it had been packed so."""
    manifest = read_manifest(str(shards))
    digest = hashlib.sha256((shards / f"{name}.tar").read_bytes()).hexdigest()
    said = tuple(
        replace(one, sha256=digest) if one.name == name else one for one in manifest.shards
    )
    json_files.write_checksummed(
        str(shards / "manifest.json"), asdict(replace(manifest, shards=said))
    )
