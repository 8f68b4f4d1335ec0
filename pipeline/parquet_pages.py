"""Where the values of an uncompressed Parquet column lie in its file, so that single rows can be read without their row group.

In: the bytes of a file whose column is stored plain and without nulls. Out: for each data page the number of its first value
and the byte it begins at. pyarrow reads whole row groups only, and says no place of a page.
Source: the Parquet format (parquet.thrift) and Thrift's compact protocol, of which a page's header is one struct.
"""

import mmap
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq

DATA_PAGE, DATA_PAGE_V2 = 0, 3
PLAIN = 0
# Fields of a PageHeader, and of its struct on a data page of either version.
KIND, SIZE, HEADER_V1, HEADER_V2 = 1, 3, 5, 8
VALUES, ENCODING_V1, ENCODING_V2 = 1, 2, 4
STOP, TRUE, FALSE, BYTE, I16, I32, I64, DOUBLE, BINARY, LIST, SET, MAP, STRUCT = range(13)
Struct = dict[int, "int | Struct"]
Whole = npt.NDArray[np.int64]


class NotPlain(Exception):
    """The column is stored in a way that single values cannot be read from."""


@dataclass(frozen=True, kw_only=True)
class Pages:
    """The data pages of a column, over all row groups of a file; P pages."""

    first_P: Whole
    "Number of each page's first value."
    begin_P: Whole
    "Byte of the file at which its values begin."
    values: int
    "Of the whole column."


def find_pages(parquet: pq.ParquetFile, data: mmap.mmap, column: int, width: int) -> Pages:
    """The pages of one column whose values take `width` bytes each.

    Raises NotPlain where it is compressed, encoded, or its pages do not add up.
    """
    first: list[int] = []
    begin: list[int] = []
    values = 0
    for group in range(parquet.num_row_groups):
        chunk = parquet.metadata.row_group(group).column(column)
        if chunk.compression != "UNCOMPRESSED" or chunk.has_dictionary_page:
            raise NotPlain
        at, end, before = chunk.data_page_offset, chunk.data_page_offset + chunk.total_compressed_size, values
        while at < end:
            try:
                header, body = _struct(data, at)
            except (IndexError, ValueError):  # a torn file
                raise NotPlain from None
            count = _values(header)
            size = header.get(SIZE)
            if not isinstance(size, int) or size < count * width or body + size > end:
                raise NotPlain
            first.append(values)
            begin.append(body + size - count * width)  # the levels of the list stand before the values
            values += count
            at = body + size
        if values - before != chunk.num_values:
            raise NotPlain
    return Pages(first_P=np.array(first, np.int64), begin_P=np.array(begin, np.int64), values=values)


def _values(header: Struct) -> int:
    """How many values a data page holds."""
    version = {DATA_PAGE: (HEADER_V1, ENCODING_V1), DATA_PAGE_V2: (HEADER_V2, ENCODING_V2)}
    kind = header.get(KIND)
    field, encoding = version.get(kind, (0, 0)) if isinstance(kind, int) else (0, 0)
    said = header.get(field)
    if not isinstance(said, dict) or said.get(encoding) != PLAIN:
        raise NotPlain
    count = said.get(VALUES)
    if not isinstance(count, int) or count < 0:
        raise NotPlain
    return count


def _struct(data: mmap.mmap, at: int) -> tuple[Struct, int]:
    """A struct of the compact protocol: its numbers and structs by field, and the byte behind it."""
    found: Struct = {}
    field = 0
    while True:
        step, kind = data[at] >> 4, data[at] & 15
        at += 1
        if kind == STOP:
            return found, at
        if step:
            field += step
        else:
            field, at = _number(data, at)
        if kind in (TRUE, FALSE):
            continue
        if kind == STRUCT:
            found[field], at = _struct(data, at)
        elif kind in (I16, I32, I64):
            found[field], at = _number(data, at)
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
