"""Reads photos from any storage and encodes them: one query per photo, or one per folder.

In: paths or URIs of photos, and an encoder. Out: queries with the embeddings of their views, or
with the reasons why photos were rejected.
Shapes: V views, B views of several photos, D dimensions.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from jobs.encoding.photo_encoder import DECODE_THREADS, PhotoEncoder, decode_photo
from pipeline.camera.framing import Framing, Level, PhotoViews
from pipeline.core import storage
from pipeline.core.arrays import Floats, Pixels
from pipeline.core.prefetch import prefetch_map
from pipeline.core.progress import progress
from pipeline.core.records import Rejection
from pipeline.images.camera_tags import CameraTags
from pipeline.images.decode import DecodeError
from pipeline.images.inspect import undecoded_format
from pipeline.images.optional_formats import convert_optional
from pipeline.locate.photo_files import parent_folder, read_photo_tags

READ_BATCH = 128
"Photos in memory, and encoded, at a time."
READ_THREADS = 4
"Files that are read at once: enough to hide a network's latency."


ViewMaker = Callable[[Pixels, CameraTags], PhotoViews]
"The views of a photo by which an index is searched, by what its tags say of the camera."


def one_view(photo_HW3: Pixels, tags: CameraTags) -> PhotoViews:
    """The photo as it is."""
    return PhotoViews(images=[photo_HW3])


@dataclass(frozen=True, kw_only=True)
class Query:
    """A query of an index: one photo, or several of one location."""

    name: str
    "The photo's path, or the folder's where it has several photos."
    photos: tuple[str, ...]
    views_VD: Floats | None
    "Embeddings of its views; None where none of its photos could be decoded."
    rejected: tuple[Rejection, ...]
    tags: CameraTags
    "Of the camera; of the first photo, where there are several."
    framing: Framing = "none"
    level: Level | None = None
    "The gallery's level that shows as much ground, where the photo's is known."

    @property
    def taken_at(self) -> str | None:
        return self.tags.taken_at


@dataclass(frozen=True, kw_only=True)
class _Opened:
    """A photo's views, at the network's size."""

    views: PhotoViews
    tags: CameraTags


def encode_photos(
    photos: Sequence[str], encoder: PhotoEncoder, make_views: ViewMaker = one_view
) -> list[Query]:
    """One query per photo, in order."""
    queries: list[Query] = []
    with progress(len(photos), "photos", "photos") as meter:
        for begin in range(0, len(photos), READ_BATCH):
            names = photos[begin : begin + READ_BATCH]
            read = prefetch_map(read_photo, names, READ_THREADS, 2 * READ_THREADS)
            pairs = zip(names, read, strict=True)
            opened = list(
                prefetch_map(
                    lambda pair: _open_views(*pair, encoder, make_views),
                    pairs,
                    DECODE_THREADS,
                    4 * DECODE_THREADS,
                )
            )
            images = [
                image for one in opened if isinstance(one, _Opened) for image in one.views.images
            ]
            rows_BD = np.concatenate(
                [encoder.forward(images[at : at + READ_BATCH])
                 for at in range(0, max(len(images), 1), READ_BATCH)]
            )  # fmt: skip
            first = 0
            for name, one in zip(names, opened, strict=True):
                count = len(one.views.images) if isinstance(one, _Opened) else 0
                queries.append(_query(name, one, rows_BD[first : first + count]))
                first += count
            meter.advance(len(names))
    return queries


def _open_views(
    name: str, data: bytes | Rejection, encoder: PhotoEncoder, make_views: ViewMaker
) -> _Opened | Rejection:
    if isinstance(data, Rejection):
        return data
    try:
        tags = read_photo_tags(data)
        views = make_views(decode_photo(data), tags)
    except DecodeError as error:
        return _by_name(Rejection(path=name, reason=error.reason, found=error.found))
    resized = [encoder.to_input(view) for view in views.images]
    return _Opened(views=replace(views, images=resized), tags=tags)


def _query(name: str, one: _Opened | Rejection, rows_VD: Floats) -> Query:
    if isinstance(one, Rejection):
        return Query(name=name, photos=(name,), views_VD=None, rejected=(one,), tags=CameraTags())
    return Query(
        name=name, photos=(name,), views_VD=rows_VD, rejected=(), tags=one.tags,
        framing=one.views.framing, level=one.views.level,
    )  # fmt: skip


def read_photo(photo: str) -> bytes | Rejection:
    """The photo's bytes, converted where its format needs it; or why it cannot be read."""
    try:
        data = storage.read_bytes(photo)
    except OSError as error:
        return Rejection(path=photo, reason="unreadable file", found=str(error))
    return convert_optional(photo, data)


def _by_name(rejection: Rejection) -> Rejection:
    """The rejection; of bytes that are no known image, by the format that the name promises."""
    if rejection.reason != "not an image":
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
    rows = [query.views_VD[0] for query in group if query.views_VD is not None]
    total_D = np.sum(rows, axis=0) if rows else None
    return Query(
        name=folder,
        photos=tuple(query.name for query in group),
        views_VD=None if total_D is None else (total_D / np.linalg.norm(total_D))[None],
        rejected=tuple(rejection for query in group for rejection in query.rejected),
        tags=next((query.tags for query in group if query.taken_at), CameraTags()),
    )
