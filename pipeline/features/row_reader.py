"""Reads single embeddings from a feature table on a local disk, by part and row number.

Parts are mapped into memory, so only the requested rows are read and the operating system caches
what is requested often. The first read from a page reads all of it and compares its checksum: 65
us, once a page and reader. An index that reranks its results, or searches a few candidates exactly,
needs no copy of the vectors.
Shapes: R requested rows, D dimensions, P pages, W bytes of an embedding.
"""

import mmap
import resource
import time
from collections import OrderedDict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.core import storage
from pipeline.core.arrays import Floats, Halves, Ints, Mask
from pipeline.core.errors import InputError
from pipeline.features.parquet_pages import ColumnPages, DamagedPage, NotPlain, find_pages
from pipeline.features.part import REPAIR_HINT, open_part, part_header

COLD_ROW_S = 0.0005
"""Seconds a row from which on it came from a disk: from memory it takes 2 us, and 65 more where its
page is read for the first time."""
Wanted = tuple[str, str, Ints]
"A part, the shard that it was made of, and the numbers of rows in it."
MAX_MAPPED_PARTS = 32_768
"Half of the mappings that Linux gives a process by default."


@dataclass(frozen=True, kw_only=True)
class _MappedPart:
    file: mmap.mmap
    bytes_N: npt.NDArray[np.uint8]
    "The whole file."
    pages: ColumnPages
    dtype: "np.dtype[np.float16] | np.dtype[np.float32]"
    verified_P: Mask
    "Pages whose checksum was compared."


class RowReader:
    """The embeddings of a table's parts by row number within a part. Not thread-safe."""

    def __init__(self, table: str, dimension: int) -> None:
        self._table, self._dimension = table, dimension
        self._most_open = most_open_parts()
        self._open: OrderedDict[str, _MappedPart] = OrderedDict()

    def read(self, part: str, shard_sha256: str, row_R: Ints) -> Floats | Halves:
        """Embeddings (R, D) of rows of a part, as stored, in the order of `row_R`.

        `shard_sha256` is the shard that the part was made of. Raises InputError where the part is
        missing, made of another shard, or not stored as embed_gallery stores it.
        """
        mapped = self._part(part, shard_sha256)
        pages, width = mapped.pages, self._dimension * mapped.dtype.itemsize
        rows_RW = np.empty((len(row_R), width), np.uint8)
        end_P = np.append(pages.first_P[1:], pages.values)
        value_R, page_R, begin_R = self._find(mapped, row_R)
        in_one_R = value_R + self._dimension <= end_P[page_R]
        last_R = np.searchsorted(pages.first_P, value_R + self._dimension - 1, side="right") - 1
        self._check_pages(part, mapped, page_R, last_R)
        in_one = np.flatnonzero(in_one_R).tolist()
        for row, begin in zip(in_one, begin_R[in_one_R].tolist(), strict=True):
            rows_RW[row] = mapped.bytes_N[begin : begin + width]
        for row in np.flatnonzero(~in_one_R).tolist():
            rows_RW[row] = self._across_pages(mapped, int(value_R[row]), int(page_R[row]))
        return rows_RW.view(mapped.dtype)

    def read_all(self, wanted: Sequence[Wanted]) -> list[Floats | Halves]:
        """`read` of several parts. Where the first rows show that the disk is slow, the others are
        requested at once and not one after another; from memory that would cost more than it saves.
        """
        blocks, cold = list[Floats | Halves](), False
        for number, one in enumerate(wanted):
            begin = time.perf_counter()
            blocks.append(self.read(*one))
            if not cold and time.perf_counter() - begin > COLD_ROW_S * len(one[2]):
                cold = True
                for other in wanted[number + 1 :]:
                    self._request(*other)
        return blocks

    def _request(self, part: str, shard_sha256: str, row_R: Ints) -> None:
        """Ask the operating system for rows that will be read."""
        mapped = self._part(part, shard_sha256)
        pages = mapped.pages
        _, page_R, begin_R = self._find(mapped, row_R)
        end_R = begin_R + self._dimension * mapped.dtype.itemsize
        # Of a page that was not read yet the whole is compared with its checksum.
        new_R = ~mapped.verified_P[page_R]
        begin_R = np.where(new_R, pages.page_P[page_R], begin_R) // mmap.PAGESIZE * mmap.PAGESIZE
        end_R = np.where(new_R, pages.end_P[page_R], end_R)
        for begin, end in dict.fromkeys(zip(begin_R.tolist(), end_R.tolist(), strict=True)):
            mapped.file.madvise(mmap.MADV_WILLNEED, begin, end - begin)

    def _find(self, mapped: _MappedPart, row_R: Ints) -> tuple[Ints, Ints, Ints]:
        """Number of each row's first value, of the page that it begins in, and the byte there."""
        pages, value_R = mapped.pages, row_R * self._dimension
        page_R = np.searchsorted(pages.first_P, value_R, side="right") - 1
        within_R = (value_R - pages.first_P[page_R]) * mapped.dtype.itemsize
        return value_R, page_R, pages.begin_P[page_R] + within_R

    def _check_pages(self, part: str, mapped: _MappedPart, first_R: Ints, last_R: Ints) -> None:
        """Compare the checksums of the pages that rows reach, each from a first to a last page.

        Raises InputError where one differs.
        """
        if mapped.verified_P.all():
            return
        change_P = np.zeros(len(mapped.verified_P) + 1, np.int32)
        np.add.at(change_P, first_R, 1)  # where a row begins
        np.add.at(change_P, last_R + 1, -1)  # behind its end
        reached_P = np.cumsum(change_P)[:-1] > 0
        for page in np.flatnonzero(reached_P & ~mapped.verified_P).tolist():
            try:
                mapped.pages.verify(mapped.bytes_N.data, page)
            except DamagedPage as error:
                path = storage.join(self._table, part)
                raise InputError(f"{path} is damaged ({error}); {REPAIR_HINT}") from None
            mapped.verified_P[page] = True

    def _across_pages(self, mapped: _MappedPart, value: int, page: int) -> npt.NDArray[np.uint8]:
        """The bytes of a row that begins in one page and ends in another."""
        pages, width, pieces, missing = mapped.pages, mapped.dtype.itemsize, [], self._dimension
        while missing:
            end = pages.values if page + 1 == len(pages.first_P) else int(pages.first_P[page + 1])
            begin = int(pages.begin_P[page]) + (value - int(pages.first_P[page])) * width
            here = min(missing, end - value)
            pieces.append(mapped.bytes_N[begin : begin + here * width])
            value, page, missing = value + here, page + 1, missing - here
        return np.concatenate(pieces)

    def _part(self, name: str, shard_sha256: str) -> _MappedPart:
        if name in self._open:
            self._open.move_to_end(name)
            return self._open[name]
        path = storage.join(self._table, name)
        if not storage.exists(path):
            raise InputError(
                f"the index needs the vectors of {path}, which is not there; expected the feature "
                "table where it was when the index was built; put it back, or build the index "
                "again with jobs/build_index.py"
            )
        with open_part(path) as parquet:
            header = part_header(parquet, path)
            if header.footer.shard_sha256 != shard_sha256 or header.dimension != self._dimension:
                raise InputError(
                    f"{path} is no longer of the shard that the index was built from; expected an "
                    "unchanged part; build the index again with jobs/build_index.py"
                )
            mapped = _map(parquet, path, header.dtype)
        self._open[name] = mapped
        if len(self._open) > self._most_open:
            self._open.popitem(last=False)
        return mapped


def most_open_parts() -> int:
    """Parts that may be mapped at once: each takes one of the process's file descriptors, of which
    half are left to others.

    Raises the process's soft limit to the hard one: opening a part again takes a thousand times as
    long as reading a row of it, and only select(), which nothing here calls, needs the lower one.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = 2 * MAX_MAPPED_PARTS if hard == resource.RLIM_INFINITY else hard
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with suppress(OSError, ValueError):  # a system that allows less than it says
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
            soft = wanted
    return MAX_MAPPED_PARTS if soft == resource.RLIM_INFINITY else min(MAX_MAPPED_PARTS, soft // 2)


def supports_row_reads(table: str) -> bool:
    """Whether single rows can be read: the table must lie on this machine's disks."""
    return storage.is_local(table)


def _map(parquet: pq.ParquetFile, path: str, dtype: str) -> _MappedPart:
    # The columns before the embedding are one Parquet column each.
    embedding = pa.schema(parquet.schema_arrow).get_field_index("embedding")
    with open(storage.resolve(path)[1], "rb") as stream:
        data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    try:
        stored = np.dtype(np.float16) if dtype == "float16" else np.dtype(np.float32)
        pages = find_pages(parquet, data, embedding, stored.itemsize)
    except NotPlain:
        data.close()
        raise InputError(
            f"the embeddings of {path} are compressed, encoded or damaged, expected plain ones, "
            f"as jobs/embed_gallery.py writes them; {REPAIR_HINT}"
        ) from None
    return _MappedPart(
        file=data,
        bytes_N=np.frombuffer(data, np.uint8),
        pages=pages,
        dtype=stored,
        verified_P=np.zeros(len(pages.first_P), np.bool_),
    )
