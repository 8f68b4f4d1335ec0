"""The stages of the road as a fault campaign sees them: a command, what it reads and writes, and
what its content is.
"""

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import torch

from model.checkpoint import loads
from pipeline.index.searcher import Index

Content = dict[str, Any]
"What must be equal, by name."


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One job on the small set; `{here}` in its arguments is the folder that all stages share."""

    name: str
    job: str
    reads: tuple[str, ...]
    "Folders that it needs, of stages before it."
    writes: str
    arguments: str
    spread: str
    "What makes Ray's workers do it."
    alone: str
    "What makes one process do it; empty where it always asks Ray."
    verify: str | None = None
    """Arguments that check every byte of what it wrote; None where `guard` does, or running it
    again."""
    guard: str = ""
    "Added to its arguments, has every byte checked first."
    blind: tuple[str, ...] = ()
    "Damage that nobody can know of, because no hash of the file was ever told: it is not tried."
    content: Callable[[Path], Content]

    def command(self, here: Path, spread: bool, guarded: bool = False) -> list[str]:
        words = (
            self.arguments,
            self.spread if spread else self.alone,
            self.guard if guarded else "",
        )
        return " ".join(words).format(here=here).split()

    def held(self, here: Path) -> Content:
        return self.content(here / self.writes)


def files_of(folder: Path) -> Content:
    """The hash of every file."""
    found = (
        path
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith(".")
    )
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in found
    }


def trained(folder: Path) -> Content:
    """Weights, optimisers and losses; not how long a step took."""
    checkpoint = loads((folder / "last.pt").read_bytes())
    found: Content = {"epoch": checkpoint.epoch, "locations": checkpoint.locations}
    for row in checkpoint.history:
        found |= {
            f"epoch {row['epoch']} {name}": row[name]
            for name in row
            if name.endswith(("_loss", "accuracy"))
        }

    def add(name: str, value: Any) -> None:
        if isinstance(value, torch.Tensor):
            found[name] = hashlib.sha256(value.contiguous().numpy().tobytes()).hexdigest()
        elif isinstance(value, dict):
            for key, inner in value.items():
                add(f"{name}/{key}", inner)

    add("state", {name: checkpoint.state[name] for name in ("modules", "optimisers")})
    return found


def searched(folder: Path) -> Content:
    """What the index answers, and what it says that it holds."""
    index = Index(str(folder))
    queries = np.random.default_rng(0).standard_normal((20, index.dimension)).astype(np.float32)
    queries /= np.linalg.norm(queries, axis=1, keepdims=True)
    found: Content = {
        f"query {number}": [(hit.key, round(hit.score, 6)) for hit in hits]
        for number, hits in enumerate(index.search(queries, k=20))
    }
    return found | {
        "rows": len(index),
        "factory": index.facts["factory"],
        "fingerprint": index.facts["fingerprint"],
    }


def measured(folder: Path) -> Content:
    """Every measure and every query's answers."""
    found: Content = {
        name: json.loads((folder / name).read_text())
        for name in ("metrics.json", "views.json", "parts.json")
    }
    rows = pq.read_table(folder / "queries.parquet").to_pylist()
    return found | {f"row {number}": repr(row) for number, row in enumerate(rows)}


STAGES = (
    Stage(
        # Its images are, like a user's, what packing takes the first hash of.
        name="simulate",
        job="simulate",
        reads=(),
        writes="flights",
        alone="",
        spread="",
        blind=("output",),
        content=files_of,
        arguments="--out {here}/flights --train-locations 8 --test-locations 4 --distractors 4 --views 3 --size 64",
    ),
    Stage(
        name="pack",
        job="make_shards",
        reads=("flights",),
        writes="shards",
        alone="--workers 0",
        spread="--workers 2",
        arguments="--source university1652 --root {here}/flights --out {here}/shards --samples-per-shard 4",
        verify="--verify --out {here}/shards",
        blind=("input bit flipped", "input deleted"),
        content=files_of,
    ),
    Stage(
        name="train",
        job="train",
        reads=("shards",),
        writes="run",
        alone="--workers 0",
        spread="--workers 1",
        arguments="smoke --shards {here}/shards --out {here}/run --checkpoint-minutes 0 --keep 3 --epochs 2 "
        "--batch-size 2 --part-dim 16 --discriminator-channels 16 --probe-epochs 0",
        guard="--verify",
        content=trained,
    ),
    Stage(
        name="embed",
        job="embed_gallery",
        reads=("shards", "run"),
        writes="table",
        alone="",
        spread="--workers 2",
        arguments="--shards {here}/shards --checkpoint {here}/run/last.pt --out {here}/table --batch-size 2 "
        "--cpus-per-worker 1",
        guard="--verify",
        content=files_of,
    ),
    Stage(
        name="index",
        job="build_index",
        reads=("table",),
        writes="index",
        alone="--workers 0",
        spread="--workers 2",
        arguments="--table {here}/table --out {here}/index --factory IVF4,SQ8 --refine --parts 3",
        verify="--verify --out {here}/index",
        guard="--verify",
        content=searched,
    ),
    Stage(
        name="evaluate",
        job="evaluate",
        reads=("table", "shards"),
        writes="evaluation",
        alone="",
        spread="--workers 2",
        arguments="--table {here}/table --shards {here}/shards --out {here}/evaluation --panels 2",
        guard="--verify",
        content=measured,
    ),
)
