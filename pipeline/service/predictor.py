"""Requests -> answers: what a replica does with a batch.

In: validated requests. Out: for each an Answer, or the rejection of its photo where decoding fails.
Shapes: Q photos that can be decoded, D dimensions.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from pipeline.core.arrays import Floats
from pipeline.core.filters import Filter
from pipeline.core.geo import Circle
from pipeline.core.records import Rejection
from pipeline.index.metadata import IndexMetadata
from pipeline.locate.locate import Answer, locate_embeddings
from pipeline.service.live_index import LiveIndex
from pipeline.service.request import LocateRequest

Outcome = Answer | Rejection


class Encoder(Protocol):
    """Embeds photos as the images of the index were embedded."""

    def encode(self, photos: Sequence[bytes]) -> tuple[Floats, list[Rejection | None]]:
        """Unit embeddings (Q, D) of the photos that can be decoded, in order; and per photo None,
        or why it has no row."""


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
    refused: str | None
    "Why the newest index at the path is not in use; null where it is."


class Predictor:
    """The encoder and the index, loaded."""

    def __init__(self, index: str, encoder_for: Callable[[IndexMetadata], Encoder]) -> None:
        """`encoder_for` makes the encoder that fits an index with this metadata.

        Raises InputError when either cannot be used.
        """
        self.live = LiveIndex(index)
        self._encoder = encoder_for(self.live.current.index.metadata)

    def predict(self, requests: Sequence[LocateRequest]) -> list[Outcome]:
        """One outcome per request, in order. The whole batch is one forward pass and one index."""
        opened = self.live.current
        embeddings_QD, rejections = self._encoder.encode([request.photo for request in requests])
        outcomes: dict[int, Outcome] = {
            number: rejection for number, rejection in enumerate(rejections) if rejection
        }
        decoded = [number for number in range(len(requests)) if number not in outcomes]
        searches: dict[tuple[Circle | None, int], list[int]] = {}  # rows that share one search
        for row, number in enumerate(decoded):
            searches.setdefault((requests[number].near, requests[number].top), []).append(row)
        for (near, top), rows in searches.items():
            where = None if near is None else Filter(near=near)
            answers = locate_embeddings(
                opened.index,
                embeddings_QD[rows],
                top,
                where,
                opened.calibration,
                opened.spacing_m,
            )
            outcomes |= {decoded[row]: answer for row, answer in zip(rows, answers, strict=True)}
        return [outcomes[number] for number in range(len(requests))]

    def status(self) -> ServiceStatus:
        opened = self.live.current
        return ServiceStatus(
            fingerprint=opened.index.metadata.fingerprint,
            rows=len(opened.index),
            factory=opened.index.metadata.factory,
            calibrated=opened.calibration is not None,
            refused=self.live.refused,
        )
