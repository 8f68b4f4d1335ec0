"""The interface between the HTTP side and the processes that compute."""

from collections.abc import Sequence
from typing import Protocol

from pipeline.service.photo_map import PictureRequest
from pipeline.service.predictor import Outcome, ServiceStatus
from pipeline.service.request import LocateRequest


class NotReady(Exception):
    """No replica has loaded the encoder and the index yet. The message is one sentence."""


class Engine(Protocol):
    """Computes the answers of batches of requests."""

    async def predict(self, requests: Sequence[LocateRequest]) -> Sequence[Outcome]:
        """One outcome per request, in order. Raises NotReady, and ReplicaLost where the batch is
        lost."""

    async def picture(self, wanted: PictureRequest) -> bytes | None:
        """A WebP of the gallery's pixels; None where they are not at hand. Raises NotReady or
        ReplicaLost."""

    async def status(self) -> ServiceStatus:
        """Raises NotReady or ReplicaLost."""
