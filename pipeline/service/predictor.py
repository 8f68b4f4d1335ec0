"""Requests -> answers: what a replica does with a batch.

In: validated requests. Out: for each an answer, or the rejection of its photo where decoding fails.
Shapes: Q photos that can be decoded, B their views, D dimensions.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from pipeline.camera.framing import PhotoViews
from pipeline.camera.overhead import overhead_view
from pipeline.camera.pose import Perspective
from pipeline.core.arrays import Floats, Pixels
from pipeline.core.filters import Filter
from pipeline.core.geo import Circle
from pipeline.core.prefetch import prefetch_map
from pipeline.core.records import Rejection
from pipeline.images.camera_tags import CameraTags
from pipeline.images.decode import DecodeError, decode
from pipeline.index.metadata import IndexMetadata
from pipeline.locate.locate import (
    CONSENSUS_CANDIDATES,
    Answer,
    answers_from_hits,
    search_views,
)
from pipeline.locate.photo_files import read_photo_tags
from pipeline.matching.photo_pose import pose_of_photo
from pipeline.service.live_index import LiveIndex, OpenedIndex
from pipeline.service.photo_map import (
    FramedPhoto,
    Located,
    MapOpener,
    PhotoMap,
    PictureRequest,
    no_map,
)
from pipeline.service.request import LocateRequest

Outcome = Located | Rejection
DECODE_THREADS = 2
"The network computes on all cores beside them."


class Encoder(Protocol):
    """Embeds photos as the images of the index were embedded."""

    def to_input(self, image_HW3: Pixels) -> Pixels:
        """Pixels at the network's size."""

    def forward(self, images: Sequence[Pixels]) -> Floats:
        """Unit embeddings (B, D) of images of the network's size."""

    @property
    def perspective(self) -> Perspective:
        """How UAV images are seen."""


@dataclass(frozen=True, kw_only=True)
class ServiceStatus:
    """The encoder and the index that answer."""

    fingerprint: str
    "Fingerprint of the encoder, its settings and the preprocessing that made the index."
    rows: int
    "Rows of the index in use."
    factory: str
    "FAISS factory string of the index."
    calibrated: bool
    "Whether answers have a probability."
    matched: bool
    "Whether photos are matched with the map's pixels."
    refused: str | None
    "Why the newest index at the path is not in use; null where it is."


class Predictor:
    """The encoder, the index and the map's pixels, loaded."""

    def __init__(
        self,
        index: str,
        encoder_for: Callable[[IndexMetadata], Encoder],
        open_map: MapOpener = no_map,
    ) -> None:
        """`encoder_for` makes the encoder that fits an index with this metadata.

        Raises InputError when any cannot be used.
        """
        self.live = LiveIndex(index, open_map)
        self._encoder = encoder_for(self.live.current.index.metadata)

    def predict(self, requests: Sequence[LocateRequest]) -> list[Outcome]:
        """One outcome per request, in order. The whole batch is one forward pass and one index."""
        opened = self.live.current
        ahead = min(len(requests), DECODE_THREADS)
        photos = list(
            prefetch_map(lambda one: self._open(one, opened.photo_map), requests, ahead, 2 * ahead)
        )
        framed = {at: one for at, one in enumerate(photos) if isinstance(one, FramedPhoto)}
        answers = self._answer(requests, framed, opened)
        return [
            one if isinstance(one, Rejection) else _refined(opened, answers[at], one, requests[at])
            for at, one in enumerate(photos)
        ]

    def _open(self, request: LocateRequest, photo_map: PhotoMap | None) -> FramedPhoto | Rejection:
        """The photo's views at the network's size, and its features."""
        try:
            photo_HW3 = decode(request.photo)
        except DecodeError as error:
            return Rejection(path="photo", reason=error.reason, found=error.found)
        tags = read_photo_tags(request.photo)
        if photo_map is not None and photo_map.matches:
            framed = photo_map.frame(photo_HW3, tags, request.pose)
        else:
            framed = FramedPhoto(views=PhotoViews(images=[self._seen(photo_HW3, tags, request)]))
        resized = [self._encoder.to_input(view) for view in framed.views.images]
        return replace(framed, views=replace(framed.views, images=resized))

    def _seen(self, photo_HW3: Pixels, tags: CameraTags, request: LocateRequest) -> Pixels:
        """The photo as the encoder sees UAV images where they are not framed as tiles are."""
        if self._encoder.perspective == "as_taken":
            return photo_HW3
        pose = pose_of_photo(tags, (photo_HW3.shape[1], photo_HW3.shape[0]), request.pose)
        return overhead_view(photo_HW3, vars(pose))

    def _answer(
        self, requests: Sequence[LocateRequest], framed: dict[int, FramedPhoto], opened: OpenedIndex
    ) -> dict[int, Answer]:
        """The answers of retrieval, by the numbers of their requests."""
        rows_BD = self._encoder.forward(
            [view for one in framed.values() for view in one.views.images]
        )
        ends = np.cumsum([len(one.views.images) for one in framed.values()])[:-1]
        embeddings = dict(zip(framed, np.split(rows_BD, ends), strict=True)) if framed else {}
        searches: dict[tuple[Circle | None, int], list[int]] = {}  # photos that share one search
        for at in framed:
            k = max(requests[at].top, CONSENSUS_CANDIDATES)  # matching tries more than are listed
            searches.setdefault((requests[at].near, k), []).append(at)
        answers: dict[int, Answer] = {}
        for (near, k), group in searches.items():
            where = None if near is None else Filter(near=near)
            levels = [framed[at].views.level for at in group]
            hits = search_views(opened.index, [embeddings[at] for at in group], k, where, levels)
            found = answers_from_hits(
                hits, k, opened.calibration, opened.spacing_m, opened.finest_side_m
            )
            answers |= dict(zip(group, found, strict=True))
        return answers

    def picture(self, wanted: PictureRequest) -> bytes | None:
        """A WebP of the gallery's pixels; None where they are not at hand."""
        photo_map = self.live.current.photo_map
        return None if photo_map is None else photo_map.picture(wanted)

    def status(self) -> ServiceStatus:
        opened = self.live.current
        return ServiceStatus(
            fingerprint=opened.index.metadata.fingerprint,
            rows=len(opened.index),
            factory=opened.index.metadata.factory,
            calibrated=opened.calibration is not None,
            matched=opened.photo_map is not None and opened.photo_map.matches,
            refused=self.live.refused,
        )


def _refined(
    opened: OpenedIndex, answer: Answer, photo: FramedPhoto, request: LocateRequest
) -> Located:
    """The answer as it is sent: matched with the map, and with the candidates asked for."""
    located = Located(answer=replace(answer, framing=photo.views.framing))
    if opened.photo_map is not None:
        located = opened.photo_map.refine(located.answer, photo, opened.calibration)
    listed = located.answer.candidates[: request.top]
    return replace(located, answer=replace(located.answer, candidates=listed))
