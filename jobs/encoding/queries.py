"""Reads photos from any storage and encodes them: one query per photo, or one per folder.

In: paths or URIs of photos, and an encoder. Out: queries with embeddings, or with the reasons why
photos were rejected.
Shapes: Q photos, D dimensions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from jobs.encoding.photo_encoder import PhotoEncoder
from pipeline.core import storage
from pipeline.core.arrays import Floats
from pipeline.core.prefetch import prefetch_map
from pipeline.core.progress import progress
from pipeline.core.records import Rejection
from pipeline.images.inspect import undecoded_format
from pipeline.images.optional_formats import convert_optional
from pipeline.locate.photo_files import parent_folder, read_taken_at

READ_BATCH = 128
"Photos in memory, and encoded, at a time."
READ_THREADS = 4
"Files that are read at once: enough to hide a network's latency."


@dataclass(frozen=True, kw_only=True)
class Query:
    """A query of an index: one photo, or several of one location."""

    name: str
    "The photo's path, or the folder's where it has several photos."
    photos: tuple[str, ...]
    embedding_D: Floats | None
    "None where none of its photos could be decoded."
    rejected: tuple[Rejection, ...]
    taken_at: str | None


def encode_photos(photos: Sequence[str], encoder: PhotoEncoder) -> list[Query]:
    """One query per photo, in order."""
    queries: list[Query] = []
    with progress(len(photos), "photos", "photos") as meter:
        for begin in range(0, len(photos), READ_BATCH):
            names = photos[begin : begin + READ_BATCH]
            read = list(prefetch_map(_read, names, READ_THREADS, 2 * READ_THREADS))
            contents = [b"" if isinstance(data, Rejection) else data for data in read]
            embeddings_QD, undecodable = encoder.encode(contents, names)
            rejected = [
                one if isinstance(one, Rejection) else _by_name(two)
                for one, two in zip(read, undecodable, strict=True)
            ]
            rows = iter(embeddings_QD)
            queries += [
                Query(
                    name=name,
                    photos=(name,),
                    embedding_D=None if rejection else next(rows),
                    rejected=(rejection,) if rejection else (),
                    taken_at=None if rejection else read_taken_at(data),
                )
                for name, data, rejection in zip(names, contents, rejected, strict=True)
            ]
            meter.advance(len(names))
    return queries


def _read(photo: str) -> bytes | Rejection:
    try:
        data = storage.read_bytes(photo)
    except OSError as error:
        return Rejection(path=photo, reason="unreadable file", found=str(error))
    return convert_optional(photo, data)


def _by_name(rejection: Rejection | None) -> Rejection | None:
    """The rejection; of bytes that are no known image, by the format that the name promises."""
    if rejection is None or rejection.reason != "not an image":
        return rejection
    return undecoded_format(rejection.path) or rejection


def merge_by_folder(queries: Sequence[Query]) -> list[Query]:
    """One query per folder: the mean of its photos' embeddings, at unit length, as in the paper's
    multi-query.
    """
    ordered = sorted(queries, key=lambda query: parent_folder(query.name))
    return [
        _merged(folder, list(group))
        for folder, group in groupby(ordered, key=lambda query: parent_folder(query.name))
    ]


def _merged(folder: str, group: Sequence[Query]) -> Query:
    rows = [query.embedding_D for query in group if query.embedding_D is not None]
    total_D = np.sum(rows, axis=0) if rows else None
    return Query(
        name=folder,
        photos=tuple(query.name for query in group),
        embedding_D=None if total_D is None else total_D / np.linalg.norm(total_D),
        rejected=tuple(rejection for query in group for rejection in query.rejected),
        taken_at=next((query.taken_at for query in group if query.taken_at), None),
    )
