"""Parquet files with checksums: every page has one, and a block before the footer holds the
footer's.

In: tables and paths. Out: files that any Parquet reader opens, and their rows, or an error if a bit
has changed. pyarrow trusts a footer: one flipped bit in it may silently change statistics or rows,
or end the process. So the footer's SHA-256 is compared before pyarrow reads it. The checksum block
stands between pages and footer, where readers look for nothing: they find pages by their offsets.
Files that other programs wrote have no such block and are read without it.
"""

import hashlib
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import IO, Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.core import storage

DAMAGE_ERRORS = (pa.ArrowException, OSError, ValueError)
"""Raised over a damaged file: ArrowInvalid by this module; by pyarrow also errors of text that is
not UTF-8."""
CHECKSUM_MARK = b"pvda.seal"
CHECKSUM_BLOCK = re.compile(rb"pvda\.seal:([0-9a-f]{64}):([0-9a-f]{64}):pvda\.seal")
"""SHA-256 of all bytes before the block, and of that digest with all bytes behind the block. The
mark stands there twice, so that no flipped bit makes such a file look like one of another
program."""
CHECKSUM_BLOCK_BYTES = 2 * (len(CHECKSUM_MARK) + 1) + 2 * 64 + 1
MAGIC = b"PAR1"
TRAILER_BYTES = 8
"Bytes behind the footer: its length and the magic."
END_READ_BYTES = 1 << 16
"Bytes from the end that are read first, as pyarrow does it: they hold most footers."
HASH_BLOCK_BYTES = 1 << 22


class CheckedFile(pq.ParquetFile):  # type: ignore[misc]  # pyarrow has no types
    """A Parquet file that must yield as many rows as its footer states: a damaged page header may
    state fewer."""

    def read(self, *arguments: Any, **settings: Any) -> pa.Table:
        table = super().read(*arguments, **settings)
        _check_row_count(len(table), self.metadata.num_rows)
        return table

    def iter_batches(
        self, batch_size: int = 65_536, row_groups: Sequence[int] | None = None, **settings: Any
    ) -> Iterator[pa.RecordBatch]:
        groups, rows = list(range(self.num_row_groups) if row_groups is None else row_groups), 0
        for batch in super().iter_batches(batch_size, groups, **settings):
            rows += len(batch)
            yield batch
        _check_row_count(rows, sum(self.metadata.row_group(group).num_rows for group in groups))


def write_table(
    path: str, table: pa.Table, row_group_size: int | None = None, **options: Any
) -> None:
    """Write a table as one file, atomically. `options`: as pq.ParquetWriter takes them."""
    with writer(path, table.schema, **options) as columns:
        columns.write_table(table, row_group_size)


@contextmanager
def writer(path: str, schema: pa.Schema, **options: Any) -> Iterator[pq.ParquetWriter]:
    """A writer for a file that appears under its name when complete, or not at all.

    No column has a dictionary page: a flipped bit in the header of one, which no checksum covers,
    can change the values.
    """
    with storage.atomic_file(path) as local:
        with (
            open(local, "wb") as stream,
            pq.ParquetWriter(
                stream, schema, write_page_checksum=True, use_dictionary=False, **options
            ) as columns,
        ):
            yield columns
        with open(local, "r+b") as written:
            _append_checksum(written)


@contextmanager
def open_parquet(path: str) -> Iterator[CheckedFile]:
    """A file to read from in blocks.

    Raises one of DAMAGE_ERRORS, here or while it is read, if it is not a complete file.
    """
    with storage.open_read(path) as stream:
        _check_footer(stream)
        # With a buffer, a row group is read while it is decoded instead of fetched in one piece.
        yield CheckedFile(stream, buffer_size=1 << 20, page_checksum_verification=True)


def read_table(path: str, columns: list[str] | None = None) -> pa.Table:
    """All rows of a file. Raises one of DAMAGE_ERRORS if it is not what was written."""
    with open_parquet(path) as parquet:
        return parquet.read(columns=columns)


def select_or_null(table: pa.Table, columns: Sequence[str] | None, schema: pa.Schema) -> pa.Table:
    """Columns of a table, all of `schema` by default; those that a file of before lacks and that
    may be null are null.

    Raises KeyError for any other that is absent.
    """
    names = schema.names if columns is None else columns
    for name in names:
        if name not in table.column_names and schema.field(name).nullable:
            nulls = pa.nulls(len(table), schema.field(name).type)
            table = table.append_column(schema.field(name), nulls)
    return table.select(names)


def verify_parquet(path: str) -> None:
    """Raise one of DAMAGE_ERRORS if any byte of a file is not what was written.

    Of a file of another program every row is read instead.
    """
    with storage.open_read(path) as stream:
        written = _check_footer(stream)
        if written is not None and _hash(stream, written[0]) != written[1]:
            raise pa.ArrowInvalid("its pages are not what was written")
    if written is None:
        with open_parquet(path) as parquet:
            for _ in parquet.iter_batches():
                pass


def parquet_intact(path: str) -> bool:
    """Whether `verify_parquet` finds no fault in a file."""
    try:
        verify_parquet(path)
    except DAMAGE_ERRORS:
        return False
    return True


def _append_checksum(stream: IO[bytes]) -> None:
    """Insert the checksum block before the footer of a finished file."""
    begin, footer = _read_footer(stream)
    pages = _hash(stream, begin)
    stream.seek(begin)
    stream.write(b":".join([CHECKSUM_MARK, pages, _digest(pages + footer), CHECKSUM_MARK]) + footer)


def _check_footer(stream: IO[bytes]) -> tuple[int, bytes] | None:
    """Where the pages end, and the SHA-256 that they had when they were written; None if the file
    has no checksum block.

    Raises ArrowInvalid if the footer is not what was written.
    """
    begin, footer = _read_footer(stream)
    end = max(0, begin - CHECKSUM_BLOCK_BYTES)
    stream.seek(end)
    found = CHECKSUM_BLOCK.fullmatch(stream.read(begin - end))
    if found is None:
        stream.seek(min(end, max(0, stream.seek(0, 2) - END_READ_BYTES)))
        if CHECKSUM_MARK in stream.read():
            raise pa.ArrowInvalid("its footer is not what was written")
    elif _digest(found[1] + footer) != found[2]:
        raise pa.ArrowInvalid("its footer is not what was written")
    stream.seek(0)
    return None if found is None else (end, found[1])


def _read_footer(stream: IO[bytes]) -> tuple[int, bytes]:
    """Where the footer begins, and its bytes with the trailer that states its length."""
    size = stream.seek(0, 2)
    stream.seek(max(0, size - END_READ_BYTES))
    end = stream.read()
    if len(end) < TRAILER_BYTES or end[-4:] != MAGIC:
        raise pa.ArrowInvalid("it does not end as a Parquet file ends")
    length = struct.unpack("<I", end[-8:-4])[0] + TRAILER_BYTES
    if length > size:
        raise pa.ArrowInvalid(f"it has {size} bytes and states a footer of {length}")
    if length > len(end):
        stream.seek(size - length)
        end = stream.read()
    return size - length, end[-length:]


def _hash(stream: IO[bytes], end: int) -> bytes:
    """SHA-256 of the first bytes of a file, in hexadecimal digits."""
    digest = hashlib.sha256()
    stream.seek(0)
    while end and (block := stream.read(min(HASH_BLOCK_BYTES, end))):
        digest.update(block)
        end -= len(block)
    return digest.hexdigest().encode()


def _digest(data: bytes) -> bytes:
    return hashlib.sha256(data).hexdigest().encode()


def _check_row_count(found: int, expected: int) -> None:
    if found != expected:
        raise pa.ArrowInvalid(f"its pages hold {found} rows and its footer states {expected}")
