"""Questions -> answers: what a replica does with a batch.

In: questions whose photos were judged. Out: for each an Answer, or why its photo cannot be decoded
after all. Shapes: Q photos that can be decoded, D dimensions.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from pipeline.core.geo import Circle
from pipeline.core.records import Rejection
from pipeline.features.table import Floats
from pipeline.index.filters import Filter
from pipeline.locate.locate import Answer, locate_embeddings
from pipeline.service.live_index import LiveIndex
from pipeline.service.request import LocateRequest

Outcome = Answer | Rejection


class Encoder(Protocol):
    """What turns photos into embeddings as those of the index were made."""

    def encode(self, photos: Sequence[bytes]) -> tuple[Floats, list[Rejection | None]]:
        """Unit embeddings (Q, D) of the photos that can be decoded, in order; per photo None or why
        it has no row.
        """


@dataclass(frozen=True, kw_only=True)
class ServiceStatus:
    """What is ready to answer."""

    fingerprint: str
    "Of the network, its settings and the preprocessing that made the index."
    rows: int
    "Of the index in use."
    factory: str
    "How FAISS holds them."
    calibrated: bool
    "Whether answers have a probability."
    refused: str | None
    "Why the newest index at the path is not in use; None where it is."


class Predictor:
    """The network and the index, loaded."""

    def __init__(self, index: str, encoder_for: Callable[[dict[str, Any]], Encoder]) -> None:
        """`encoder_for` makes the encoder that fits an index of these facts. Raises InputError when
        either is unusable.
        """
        self.live = LiveIndex(index)
        self._encoder = encoder_for(self.live.current.index.facts)

    def answer(self, questions: Sequence[LocateRequest]) -> list[Outcome]:
        """One outcome per question, in order. The whole batch asks one index, and the network once."""
        opened = self.live.current
        embeddings_QD, rejected = self._encoder.encode([question.photo for question in questions])
        outcomes: dict[int, Outcome] = {
            number: why for number, why in enumerate(rejected) if why is not None
        }
        alike: dict[
            tuple[Circle | None, int], list[tuple[int, int]]
        ] = {}  # question and row of those of one search
        for row, number in enumerate(number for number, why in enumerate(rejected) if why is None):
            alike.setdefault((questions[number].near, questions[number].top), []).append(
                (number, row)
            )
        for (near, top), members in alike.items():
            where = None if near is None else Filter(near=near)
            answers = locate_embeddings(
                opened.index,
                embeddings_QD[[row for _, row in members]],
                top,
                where,
                opened.confidence,
            )
            outcomes |= {
                number: answer for (number, _), answer in zip(members, answers, strict=True)
            }
        return [outcomes[number] for number in range(len(questions))]

    def status(self) -> ServiceStatus:
        opened = self.live.current
        return ServiceStatus(
            fingerprint=opened.index.told.fingerprint,
            rows=len(opened.index),
            factory=opened.index.told.factory,
            calibrated=opened.confidence is not None,
            refused=self.live.refused,
        )
