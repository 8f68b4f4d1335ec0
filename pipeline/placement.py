"""How many workers a cluster is asked for, and how much of it each.

In: the nodes as they are, what was asked for. Out: a Placement. A plain function of these; Ray is asked elsewhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass

CORES = 8
"Of a worker without a GPU, where nothing was said: a network's threads gain little beyond."


@dataclass(frozen=True, kw_only=True)
class Node:
    """One machine of a cluster."""

    cpus: float
    gpus: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Placement:
    """What is asked of Ray."""

    workers: int
    cpus: int
    "Of each worker."
    gpus: float
    "Of each worker."

    def __str__(self) -> str:
        return f"{self.cpus} CPUs and {self.gpus:g} GPUs" if self.gpus else f"{self.cpus} CPUs"


def place(
    nodes: Sequence[Node], items: int, workers: int | None = None, cpus: int | None = None, gpus: float | None = None
) -> Placement:
    """A placement for so many items. None: one worker per GPU where there are any, else one per eight cores of a node; and
    as many cores each as let all of them fit on the nodes that are there, at least 1."""
    if gpus is None:
        gpus = 1.0 if any(node.gpus >= 1 for node in nodes) else 0.0
    if workers is None:
        workers = sum(_room(node, cpus or (1 if gpus else min(CORES, max(1, int(node.cpus)))), gpus) for node in nodes)
    workers = max(1, min(workers, items))
    if cpus is None:
        most = int(max((node.cpus for node in nodes), default=1))
        fitting = (c for c in range(most, 1, -1) if sum(_room(node, c, gpus) for node in nodes) >= workers)
        cpus = next(fitting, 1)
    return Placement(workers=workers, cpus=cpus, gpus=gpus)


def _room(node: Node, cpus: int, gpus: float) -> int:
    """How many such workers a node holds."""
    by_cpus = int(node.cpus // cpus)
    return min(by_cpus, int(node.gpus // gpus)) if gpus else by_cpus
