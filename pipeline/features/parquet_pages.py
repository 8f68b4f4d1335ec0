"""The data pages of an uncompressed Parquet column: where their values lie, and their checksums.

In: the bytes of a file whose column is stored plain and without nulls. Out: for each data page the
number of its first value, the byte at which it begins, and the checksum in its header. With these,
single rows are read and verified without their row group; pyarrow reads row groups as a whole and
does not report where pages lie.
Source: the Parquet format (parquet.thrift) and Thrift's compact protocol, of which a page's header
is one struct.
Shapes: P pages, over all row groups of a file.
"""

import mmap
import zlib
from dataclasses import dataclass

import numpy as np
import pyarrow.parquet as pq

from pipeline.core.arrays import Ints

DATA_PAGE, DATA_PAGE_V2 = 0, 3
PLAIN = 0
# Fields of a PageHeader, and of its struct on a data page of either version.
KIND, SIZE, CRC, HEADER_V1, HEADER_V2 = 1, 3, 4, 5, 8
VALUES, ENCODING_V1, ENCODING_V2 = 1, 2, 4
STOP, TRUE, FALSE, BYTE, I16, I32, I64, DOUBLE, BINARY, LIST, SET, MAP, STRUCT = range(13)
Struct = dict[int, "int | Struct"]
NO_CRC = -1


class DamagedPage(Exception):
    """A page's checksum is not that of its header."""


class NotPlain(Exception):
    """The column is stored in a way that single values cannot be read from."""


@dataclass(frozen=True, kw_only=True)
class ColumnPages:
    """The data pages of a column."""

    first_P: Ints
    "Number of each page's first value."
    begin_P: Ints
    "Byte of the file at which its values begin."
    page_P: Ints
    "Byte at which each page begins, behind its header; a list's levels stand before the values."
    end_P: Ints
    "Byte behind it."
    crc_P: Ints
    "CRC-32 of these bytes; NO_CRC where another program wrote the file without any."
    values: int
    "In the whole column."

    def verify(self, data: memoryview, page: int) -> None:
        """Compare a page's bytes with the checksum of its header. Raises DamagedPage."""
        begin, crc = int(self.page_P[page]), int(self.crc_P[page])
        if crc != NO_CRC and zlib.crc32(data[begin : int(self.end_P[page])]) != crc:
            raise DamagedPage(f"the checksum of the page at byte {begin} differs")


def find_pages(parquet: pq.ParquetFile, data: mmap.mmap, column: int, width: int) -> ColumnPages:
    """The pages of one column whose values take `width` bytes each.

    Raises NotPlain where it is compressed or encoded, or its pages do not add up to the column.
    """
    pages: list[tuple[int, int, int, int, int]] = []
    values = 0
    for group in range(parquet.num_row_groups):
        chunk = parquet.metadata.row_group(group).column(column)
        if chunk.compression != "UNCOMPRESSED" or chunk.has_dictionary_page:
            raise NotPlain
        at, before = chunk.data_page_offset, values
        end = at + chunk.total_compressed_size
        while at < end:
            try:
                header, body = _struct(data, at)
            except (IndexError, ValueError):  # a truncated file
                raise NotPlain from None
            count = _value_count(header)
            size, crc = header.get(SIZE), header.get(CRC)
            if not isinstance(size, int) or size < count * width or body + size > end:
                raise NotPlain
            checksum = crc & 0xFFFFFFFF if isinstance(crc, int) else NO_CRC
            pages.append((values, body + size - count * width, body, body + size, checksum))
            values += count
            at = body + size
        if values - before != chunk.num_values:
            raise NotPlain
    first_P, begin_P, page_P, end_P, crc_P = np.array(pages, np.int64).reshape(-1, 5).T
    return ColumnPages(
        first_P=first_P, begin_P=begin_P, page_P=page_P, end_P=end_P, crc_P=crc_P, values=values
    )


def _value_count(header: Struct) -> int:
    """Number of values in a data page. Raises NotPlain."""
    version = {DATA_PAGE: (HEADER_V1, ENCODING_V1), DATA_PAGE_V2: (HEADER_V2, ENCODING_V2)}
    kind = header.get(KIND)
    field, encoding = version.get(kind, (0, 0)) if isinstance(kind, int) else (0, 0)
    page = header.get(field)
    if not isinstance(page, dict) or page.get(encoding) != PLAIN:
        raise NotPlain
    count = page.get(VALUES)
    if not isinstance(count, int) or count < 0:
        raise NotPlain
    return count


def _struct(data: mmap.mmap, at: int) -> tuple[Struct, int]:
    """A struct of the compact protocol: its numbers and structs by field, and the byte behind."""
    fields: Struct = {}
    field = 0
    while True:
        step, kind = data[at] >> 4, data[at] & 15
        at += 1
        if kind == STOP:
            return fields, at
        if step:
            field += step
        else:
            field, at = _number(data, at)
        if kind in (TRUE, FALSE):
            continue
        if kind == STRUCT:
            fields[field], at = _struct(data, at)
        elif kind in (I16, I32, I64):
            fields[field], at = _number(data, at)
        elif kind == BINARY:
            length, at = _varint(data, at)
            at += length
        elif kind == BYTE:
            at += 1
        elif kind == DOUBLE:
            at += 8
        else:  # a page's header has no lists, sets or maps
            raise ValueError(kind)


def _number(data: mmap.mmap, at: int) -> tuple[int, int]:
    value, at = _varint(data, at)
    return (value >> 1) ^ -(value & 1), at


def _varint(data: mmap.mmap, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 127) << shift
        at += 1
        if byte < 128:
            return value, at
        shift += 7
        if shift > 63:
            raise ValueError(shift)
