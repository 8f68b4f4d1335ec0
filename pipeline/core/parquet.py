"""Parquet files whose damage is found: every page has a checksum, and a seal before the footer has
the footer's hash.

In: tables and paths. Out: files that any Parquet reader opens as they are, and their rows, or an
error where a bit has changed. pyarrow trusts a footer: one flipped bit in it may change statistics
or rows without a word, or end the process. So the footer's hash is compared before pyarrow sees it.
The seal stands between pages and footer, where readers look for nothing: they find pages by their
offsets. Files that others wrote, or we before there were seals, are read as they are.
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
"""What reading a damaged file raises: of ours ArrowInvalid; of pyarrow's also errors of texts that
are no UTF-8."""
CHECKSUM_MARK = b"pvda.seal"
CHECKSUM_BLOCK = re.compile(rb"pvda\.seal:([0-9a-f]{64}):([0-9a-f]{64}):pvda\.seal")
"""Hash of all bytes before it, and of that hash with all bytes behind it. The mark is there twice,
so that no flipped bit makes a sealed file look like one from before."""
CHECKSUM_BLOCK_BYTES = 2 * (len(CHECKSUM_MARK) + 1) + 2 * 64 + 1
MAGIC = b"PAR1"
TRAILER_BYTES = 8
"Bytes behind the footer: its length and the magic."
END_READ_BYTES = 1 << 16
"Bytes from the end that are read first: most footers whole, as pyarrow does it."
HASH_BLOCK_BYTES = 1 << 22


class CheckedFile(pq.ParquetFile):  # type: ignore[misc]  # pyarrow has no types
    """A Parquet file of which as many rows must come as its footer says: a damaged page header may
    name fewer.
    """

    def read(self, *arguments: Any, **settings: Any) -> pa.Table:
        table = super().read(*arguments, **settings)
        _check_row_count(len(table), self.metadata.num_rows)
        return table

    def iter_batches(
        self, batch_size: int = 65_536, row_groups: Sequence[int] | None = None, **settings: Any
    ) -> Iterator[pa.RecordBatch]:
        groups, seen = list(range(self.num_row_groups) if row_groups is None else row_groups), 0
        for batch in super().iter_batches(batch_size, groups, **settings):
            seen += len(batch)
            yield batch
        _check_row_count(seen, sum(self.metadata.row_group(group).num_rows for group in groups))


def write_table(
    path: str, table: pa.Table, row_group_size: int | None = None, **options: Any
) -> None:
    """Write a table as one file, whole or not at all. `options`: as pq.ParquetWriter takes them."""
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
    """A file to read from, a piece at a time. Raises one of DAMAGE, here or while it is read, where
    it is no whole file.
    """
    with storage.open_read(path) as stream:
        _check_footer(stream)
        # With a buffer, a row group is read as it is decoded and not fetched whole before.
        yield CheckedFile(stream, buffer_size=1 << 20, page_checksum_verification=True)


def read_table(path: str, columns: list[str] | None = None) -> pa.Table:
    """All rows of a file. Raises one of DAMAGE where it is no whole file."""
    with open_parquet(path) as parquet:
        return parquet.read(columns=columns)


def verify_parquet(path: str) -> bool:
    """Raise one of DAMAGE where any byte of a file is not what was written; false where it has no
    seal that would say.
    """
    with storage.open_read(path) as stream:
        said = _check_footer(stream)
        if said is None:
            return False
        begin, body = said
        if _hash(stream, begin) != body:
            raise pa.ArrowInvalid("its pages are not what was written")
    return True


def parquet_intact(path: str) -> bool:
    """Whether `verify_parquet` has nothing against a file."""
    try:
        verify_parquet(path)
    except DAMAGE_ERRORS:
        return False
    return True


def _append_checksum(stream: IO[bytes]) -> None:
    begin, footer = _footer(stream)
    body = _hash(stream, begin)
    stream.seek(begin)
    stream.write(b":".join([CHECKSUM_MARK, body, _digest(body + footer), CHECKSUM_MARK]) + footer)


def _check_footer(stream: IO[bytes]) -> tuple[int, bytes] | None:
    """Where the pages end and the hash of them all; None where the file has no seal.

    Raises ArrowInvalid where the footer is not what was written.
    """
    begin, footer = _footer(stream)
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


def _footer(stream: IO[bytes]) -> tuple[int, bytes]:
    """Where the footer begins, and its bytes with those that say its length."""
    size = stream.seek(0, 2)
    stream.seek(max(0, size - END_READ_BYTES))
    end = stream.read()
    if len(end) < TRAILER_BYTES or end[-4:] != MAGIC:
        raise pa.ArrowInvalid("it does not end as a Parquet file ends")
    length = struct.unpack("<I", end[-8:-4])[0] + TRAILER_BYTES
    if length > size:
        raise pa.ArrowInvalid(f"it has {size} bytes and says that its footer has {length}")
    if length > len(end):
        stream.seek(size - length)
        end = stream.read()
    return size - length, end[-length:]


def _hash(stream: IO[bytes], end: int) -> bytes:
    """Hash of the first bytes of a file, in hexadecimal digits."""
    digest = hashlib.sha256()
    stream.seek(0)
    while end and (piece := stream.read(min(HASH_BLOCK_BYTES, end))):
        digest.update(piece)
        end -= len(piece)
    return digest.hexdigest().encode()


def _digest(data: bytes) -> bytes:
    return hashlib.sha256(data).hexdigest().encode()


def _check_row_count(found: int, expected: int) -> None:
    if found != expected:
        raise pa.ArrowInvalid(f"{found} rows come out of its pages and its footer says {expected}")
