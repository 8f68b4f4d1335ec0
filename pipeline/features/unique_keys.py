"""The check that every key of a feature table is unique, in 8 bytes of memory a row.

In: a function that reads the keys, piece by piece. Out: nothing, or an error that names the key and
both parts.
"""

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from pipeline.core import storage
from pipeline.core.errors import InputError

Keys = Iterable[tuple[str, list[str]]]
"Names of parts with some of their keys; a part may come in several pieces."


def check_unique_keys(table: str, read: Callable[[], Keys]) -> None:
    """Raise InputError where a key occurs twice in the table at the path `table`.

    Keys are compared by 64-bit hashes; `read` is called a second time where hashes are equal, and
    these keys are compared by their text.
    """
    hash_N = np.sort(np.concatenate([np.empty(0, np.int64), *_hashes(read())]))
    repeated = set(hash_N[1:][hash_N[1:] == hash_N[:-1]].tolist())
    if not repeated:
        return
    seen: dict[str, str] = {}
    for part, keys in read():
        for key in keys:
            if hash(key) not in repeated:
                continue
            if key in seen:
                raise InputError(
                    f"{storage.join(table, part)} holds key {key}, which {seen[key]} holds too, "
                    "expected unique keys; keep the parts of one data set only, and embed others "
                    "into a folder of their own"
                )
            seen[key] = part


def _hashes(pieces: Keys) -> Iterator[np.ndarray[tuple[int], np.dtype[np.int64]]]:
    for _, keys in pieces:
        yield np.fromiter(map(hash, keys), np.int64, len(keys))
