"""Sums of an epoch's metrics: kept on the device, read on request, stored in a checkpoint.

In: metrics of steps. Out: their means. Only reading waits for the device; a step never does.
"""

import math
import time
from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

SECONDS, DAMAGED = "seconds", "damaged_images"


class NotFinite(ArithmeticError):
    """A metric is infinite or not a number. The message has its name and value."""


class MetricAccumulator:
    """Sums over the steps of one epoch. `steps` and `state` are those of the checkpoint that
    training resumes from.
    """

    def __init__(self, steps: int = 0, state: Mapping[str, Tensor] | None = None) -> None:
        sums = dict(state or {})
        self.steps = steps
        "Steps that were added."
        self.damaged = int(sums.pop(DAMAGED, 0))
        "Images that could not be decoded, of those that this worker drew."
        self._before = float(sums.pop(SECONDS, 0.0))
        self._began = time.monotonic()
        self._names = list(sums)
        self._sums: Tensor | None = torch.stack(list(sums.values())) if sums else None

    @property
    def seconds(self) -> float:
        """Spent on the epoch, including the time before a kill."""
        return self._before + time.monotonic() - self._began

    def add(self, metrics: Mapping[str, Tensor]) -> None:
        """Add one step's scalars, on whatever device they are. In float64: an epoch may have many
        steps.
        """
        values = torch.stack(list(metrics.values())).double()
        self._names = list(metrics)
        self._sums = values if self._sums is None else self._sums.to(values.device) + values
        self.steps += 1

    def means(self) -> dict[str, float]:
        """Mean of each metric over the steps so far.

        Raises NotFinite: a sum that was once infinite or NaN stays so, hence none is missed between
        two reads.
        """
        sums = [] if self._sums is None else self._sums.tolist()
        means = {name: total / self.steps for name, total in zip(self._names, sums, strict=True)}
        wrong = first_not_finite(means.items())
        if wrong is not None:
            raise NotFinite(f"{wrong} is {means[wrong]}")
        return means

    def state_dict(self) -> dict[str, Tensor]:
        """The sums as a checkpoint stores them."""
        if self._sums is None:
            return {}
        # Copies: saved as views, each scalar would carry the whole vector along.
        sums = {
            name: total.clone()
            for name, total in zip(self._names, self._sums.cpu().unbind(), strict=True)
        }
        return sums | {
            SECONDS: torch.tensor(self.seconds, dtype=torch.float64),
            DAMAGED: torch.tensor(self.damaged, dtype=torch.int64),
        }


def first_not_finite(means: Iterable[tuple[str, float]]) -> str | None:
    """The first metric that is not finite."""
    return next((name for name, mean in means if not math.isfinite(mean)), None)
