"""The list of what was refused: one row per image with its path, a countable reason, and what was
found.

In: rejections. Out: `rejected.parquet`.
"""

from collections import Counter
from collections.abc import Iterable

import pyarrow as pa

from pipeline.core import parquet, storage
from pipeline.core.errors import InputError
from pipeline.core.records import Rejection

REJECTED_FILE = "rejected.parquet"
REJECTED_SCHEMA = pa.schema(
    [("path", pa.string()), ("reason", pa.string()), ("found", pa.string())]
)


def write_rejections(folder: str, rejected: Iterable[Rejection], keep: bool) -> int:
    """Write the list, by path, and return its length; `keep`: beside what it holds already.

    Raises InputError where that cannot be read.
    """
    path = storage.join(folder, REJECTED_FILE)
    listed = {(rejection.path, rejection.reason, rejection.found) for rejection in rejected}
    if keep and storage.exists(path):
        listed.update(zip(*_read_rejections(path).to_pydict().values(), strict=True))
    table = pa.Table.from_pylist(
        [dict(zip(REJECTED_SCHEMA.names, row, strict=True)) for row in sorted(listed)],
        REJECTED_SCHEMA,
    )
    parquet.write_table(path, table)
    return len(table)


def rejections_intact(folder: str, count: int) -> bool:
    """Whether the list is there, every byte as it was written, with so many images."""
    path = storage.join(folder, REJECTED_FILE)
    try:
        return parquet.parquet_intact(path) and len(_read_rejections(path)) == count
    except InputError:  # of one without a seal
        return False


def rejected_paths(folder: str) -> frozenset[str]:
    """The images that are listed; none where there is no list. Raises InputError where it cannot be
    read.
    """
    path = storage.join(folder, REJECTED_FILE)
    return (
        frozenset(_read_rejections(path)["path"].to_pylist())
        if storage.exists(path)
        else frozenset()
    )


def _read_rejections(path: str) -> pa.Table:
    try:
        return parquet.read_table(path)
    except parquet.DAMAGE_ERRORS as error:
        raise InputError(
            f"{path} cannot be read ({error}), expected the list of refused images; delete it and run the same command again: "
            "it lists what is refused from now on"
        ) from None


def most_common_reasons(rejected: Iterable[Rejection]) -> str:
    """The three commonest reasons with their counts."""
    counts = Counter(rejection.reason for rejection in rejected).most_common(3)
    return ", ".join(f"{reason} ({count})" for reason, count in counts)
