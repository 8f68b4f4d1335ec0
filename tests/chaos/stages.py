"""The stages of the campaign: each job's command, inputs, output, and the content to compare."""

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
"What a rerun has to reproduce, by name."
IN_PROCESS = "--workers 0"
"Arguments that have a job's own process do the work."


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One job on the small set; `{here}` in its arguments is the folder that all stages share."""

    name: str
    job: str
    reads: tuple[str, ...]
    "Folders of earlier stages that it reads."
    writes: str
    arguments: str
    distributed: str
    "Arguments that have Ray's workers do the work."
    verify_output: str | None = None
    "Arguments that check every byte of the output; None if `verify_input` or a rerun does."
    verify_input: str = ""
    "Extra arguments that check every byte of the input first."
    undetectable: tuple[str, ...] = ()
    "Damage that no job can detect, because no hash of the file exists; not tried."
    content: Callable[[Path], Content]

    def command(self, folder: Path, distributed: bool, verified: bool = False) -> list[str]:
        words = (
            self.arguments,
            self.distributed if distributed else IN_PROCESS,
            self.verify_input if verified else "",
        )
        return " ".join(words).format(here=folder).split()

    def read_content(self, folder: Path) -> Content:
        return self.content(folder / self.writes)


def file_hashes(folder: Path) -> Content:
    """The hash of every file."""
    files = (
        path
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith(".")
    )
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
    }


def training_content(folder: Path) -> Content:
    """Weights, optimisers and losses; no durations."""
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

    add("state", {name: checkpoint.state[name] for name in ("modules", "optimizers")})
    return found


def index_content(folder: Path) -> Content:
    """The answers of the index, its size and its metadata."""
    index = Index(str(folder))
    queries = np.random.default_rng(0).standard_normal((20, index.dimension)).astype(np.float32)
    queries /= np.linalg.norm(queries, axis=1, keepdims=True)
    found: Content = {
        f"query {number}": [(hit.key, round(hit.score, 6)) for hit in hits]
        for number, hits in enumerate(index.search(queries, k=20))
    }
    return found | {
        "rows": len(index),
        "factory": index.metadata.factory,
        "fingerprint": index.metadata.fingerprint,
    }


def evaluation_content(folder: Path) -> Content:
    """All measures and every query's answers."""
    found: Content = {
        name: json.loads((folder / name).read_text())
        for name in ("metrics.json", "views.json", "parts.json")
    }
    rows = pq.read_table(folder / "queries.parquet").to_pylist()
    return found | {f"row {number}": repr(row) for number, row in enumerate(rows)}


STAGES = (
    Stage(
        # Packing takes the first hashes of its images, as of a user's.
        name="simulate",
        job="simulate",
        reads=(),
        writes="flights",
        distributed="--workers 2",
        undetectable=("output",),
        content=file_hashes,
        arguments="--out {here}/flights --train-locations 8 --test-locations 4 --distractors 4 "
        "--views 3 --size 64",
    ),
    Stage(
        name="pack",
        job="make_shards",
        reads=("flights",),
        writes="shards",
        distributed="--workers 2",
        arguments="--source university1652 --root {here}/flights --out {here}/shards "
        "--samples-per-shard 4",
        verify_output="--verify --out {here}/shards",
        undetectable=("input bit flipped", "input deleted"),
        content=file_hashes,
    ),
    Stage(
        name="train",
        job="train",
        reads=("shards",),
        writes="run",
        distributed="--workers 1",
        arguments="smoke --shards {here}/shards --out {here}/run --checkpoint-minutes 0 --keep 3 "
        "--epochs 2 --batch-size 2 --part-dim 16 --discriminator-channels 16 --probe-epochs 0",
        verify_input="--verify",
        content=training_content,
    ),
    Stage(
        name="embed",
        job="embed_gallery",
        reads=("shards", "run"),
        writes="table",
        distributed="--workers 2",
        arguments="--shards {here}/shards --checkpoint {here}/run/last.pt --out {here}/table "
        "--batch-size 2 --cpus-per-worker 1",
        verify_input="--verify",
        content=file_hashes,
    ),
    Stage(
        name="index",
        job="build_index",
        reads=("table",),
        writes="index",
        distributed="--workers 2",
        arguments="--table {here}/table --out {here}/index --factory IVF4,SQ8 --refine --parts 3",
        verify_output="--verify --out {here}/index",
        verify_input="--verify",
        content=index_content,
    ),
    Stage(
        name="evaluate",
        job="evaluate",
        reads=("table", "shards"),
        writes="evaluation",
        distributed="--workers 2",
        arguments="--table {here}/table --shards {here}/shards --out {here}/evaluation --panels 2",
        verify_input="--verify",
        content=evaluation_content,
    ),
)
