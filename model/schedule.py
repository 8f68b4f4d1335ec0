"""Progressive alpha and warm restarts: a pure function of the epoch.

In: the completed epochs of training. Out: alpha and the factor of every learning rate.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How alpha and the learning rates change. The defaults are the paper's."""

    epochs: int = 560
    """Passes over the satellite view in all: four periods [chosen: the ablation decays at 140, 280
    and 420]."""
    alpha: float = 0.9
    "Weight of the adversarial loss in the first period [paper]."
    alpha_step: float = 0.1
    "Increment of alpha at each new period [paper]."
    period: int = 140
    "Epochs between two increments of alpha [paper]."
    lr_schedule: Literal["step", "cosine"] = "step"
    """`step` is the paper's decay; `cosine` falls to zero over all epochs, for short runs from
    scratch."""
    decay: float = 0.8
    "Factor at each decay epoch [paper]."
    decay_epochs: tuple[int, ...] = (60, 120)
    """When the rates decay, counted from the period's start where they restart, else from the
    training's [paper]."""
    restart: bool = True
    "Whether the rates return to their start when alpha grows [paper: warm restart]."
    warmup_epochs: float = 0.0
    "Linear growth of the rates from zero at the start of training [paper: none]."
    cool_down_epochs: float = 0.0
    """The last of all epochs, in which the rates fall to zero by a cosine: restarts keep them high
    to the end [paper: none]."""

    def __post_init__(self) -> None:
        if self.epochs < 1 or self.period < 1:
            raise ValueError(
                f"epochs is {self.epochs} and period {self.period}, expected at least 1 of each"
            )
        if self.alpha < 0:
            raise ValueError(f"alpha is {self.alpha}, expected 0 (no adversary) or more")

    def scaled_to(self, epochs: int) -> "Schedule":
        """The same shape over another number of epochs."""
        share = epochs / self.epochs
        return replace(
            self,
            epochs=epochs,
            period=max(1, round(self.period * share)),
            decay_epochs=tuple(round(epoch * share) for epoch in self.decay_epochs),
            warmup_epochs=self.warmup_epochs * share,
            cool_down_epochs=self.cool_down_epochs * share,
        )


@dataclass(frozen=True, kw_only=True)
class ScheduleState:
    """Alpha and learning rates at one moment of training."""

    alpha: float
    lr_scale: float
    "Factor of every learning rate, on its initial value."


def schedule_at(schedule: Schedule, epoch: float) -> ScheduleState:
    """Alpha and learning-rate scale after `epoch` passes; fractions of an epoch matter to warm-up,
    cool-down and cosine only.
    """
    completed = math.floor(epoch)
    periods, within = divmod(completed, schedule.period)
    alpha = schedule.alpha + periods * schedule.alpha_step
    if schedule.lr_schedule == "cosine":
        scale = _cosine(min(1.0, epoch / schedule.epochs))
    else:
        counted = within if schedule.restart else completed
        scale = schedule.decay ** sum(counted >= at for at in schedule.decay_epochs)
    if epoch < schedule.warmup_epochs:
        scale *= epoch / schedule.warmup_epochs
    left = schedule.epochs - epoch
    if left < schedule.cool_down_epochs:
        scale *= _cosine(1 - left / schedule.cool_down_epochs)
    # Ten digits, so that 0.9 + 2 * 0.1 prints and compares as 1.1.
    return ScheduleState(alpha=round(alpha, 10), lr_scale=scale)


def _cosine(share: float) -> float:
    """From 1 at 0 to 0 at 1."""
    return 0.5 * (1 + math.cos(math.pi * share))
