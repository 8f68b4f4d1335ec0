"""The list of what was refused: one row per image with its path, a countable reason, and what was found.

In: rejections. Out: `rejected.parquet`.
"""

from collections import Counter
from collections.abc import Iterable

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline import storage
from pipeline.records import InputError, Rejection

FILE = "rejected.parquet"
SCHEMA = pa.schema([("path", pa.string()), ("reason", pa.string()), ("found", pa.string())])


def write(folder: str, rejected: Iterable[Rejection], keep: bool) -> int:
    """Write the list, by path, and return its length; `keep`: beside what it holds already."""
    path = storage.join(folder, FILE)
    listed = {(rejection.path, rejection.reason, rejection.found) for rejection in rejected}
    if keep and storage.exists(path):
        try:
            with storage.open_read(path) as stream:
                listed.update(
                    zip(*pq.read_table(stream, columns=SCHEMA.names).cast(SCHEMA).to_pydict().values(), strict=True)
                )
        except (pa.ArrowException, OSError, ValueError) as error:
            raise InputError(
                f"{path} cannot be read ({error}); expected the list of refused images; delete it"
            ) from None
    table = pa.Table.from_pylist([dict(zip(SCHEMA.names, row, strict=True)) for row in sorted(listed)], SCHEMA)
    with storage.atomic(path) as stream:
        pq.write_table(table, stream)
    return len(table)


def commonest(rejected: Iterable[Rejection]) -> str:
    """The three commonest reasons with their counts."""
    counts = Counter(rejection.reason for rejection in rejected).most_common(3)
    return ", ".join(f"{reason} ({count})" for reason, count in counts)
