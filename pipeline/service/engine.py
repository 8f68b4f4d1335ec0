"""Whoever computes, as the HTTP side sees it."""

from collections.abc import Sequence
from typing import Protocol

from pipeline.service.predictor import Outcome, ServiceStatus
from pipeline.service.request import LocateRequest


class NotReady(Exception):
    """Nobody has loaded the network and the index yet. One sentence."""


class Engine(Protocol):
    """Whoever computes."""

    async def answer(self, questions: Sequence[LocateRequest]) -> Sequence[Outcome]:
        """One outcome per question, in order. Raises NotReady, and Gone where the batch is lost."""

    async def status(self) -> ServiceStatus:
        """Raises NotReady or Gone."""
