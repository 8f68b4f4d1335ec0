"""A training run's folder: checkpoints that survive any kill, and metrics to watch.

In: a run's settings and state. Out: RUN/last.pt and the checkpoints before it, RUN/metrics.jsonl,
RUN/tensorboard.
"""

import json
import re
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from torch.utils.tensorboard import SummaryWriter

from jobs.training.recipes.recipe import Recipe
from jobs.training.settings import RunConfig
from model.checkpoint import Checkpoint, dumps, loads
from model.errors import CheckpointError
from pipeline.core import storage
from pipeline.core.errors import InputError

CHECKPOINT_FILE, METRICS_FILE = "last.pt", "metrics.jsonl"
FoundCheckpoint = tuple[str, Checkpoint] | None
"Name and content of the newest checkpoint that can be read."
ARCHIVE_PATTERN = re.compile(r"checkpoint-(\d+)-(\d+)\.pt")


def archive_name(checkpoint: Checkpoint) -> str:
    """The name of a checkpoint that is no longer the last one."""
    return f"checkpoint-{checkpoint.epoch:04d}-{checkpoint.step:05d}.pt"


def list_archived(out: str) -> list[str]:
    """The checkpoints before the last one, newest first."""
    found = [
        match for name in storage.list_names(out) if (match := ARCHIVE_PATTERN.fullmatch(name))
    ]
    return [
        match[0]
        for match in sorted(found, key=lambda match: (int(match[1]), int(match[2])), reverse=True)
    ]


def find_checkpoint(
    run: RunConfig, log: Callable[[str], None] = lambda message: None
) -> FoundCheckpoint:
    """Name and content of the run's newest checkpoint that can be read, if it has any; `log` gets a
    message for each that cannot.

    Raises InputError when it is of another recipe, CheckpointError when none of them can be read.
    """
    names = [
        name
        for name in (CHECKPOINT_FILE, *list_archived(run.out))
        if storage.exists(storage.join(run.out, name))
    ]
    if names and names[0] != CHECKPOINT_FILE:
        log(
            f"{storage.join(run.out, CHECKPOINT_FILE)} is missing; taking {names[0]}, the one "
            "before it"
        )
    for number, name in enumerate(names, start=1):
        path = storage.join(run.out, name)
        try:
            checkpoint = loads(storage.read_bytes(path), path)
        except CheckpointError as error:
            if number == len(names):
                raise
            log(f"{error}; taking {names[number]}, the one before it")
            continue
        require_same_recipe(run, checkpoint, path)
        return name, checkpoint
    return None


def read_checkpoint(run: RunConfig) -> Checkpoint | None:
    """The run's newest checkpoint that can be read, if it has any. Raises as `find_checkpoint`
    does.
    """
    found = find_checkpoint(run)
    return None if found is None else found[1]


def with_defaults(settings: dict[str, Any], defaults: dict[str, Any]) -> dict[str, Any]:
    """Settings by name, those within settings too, with the defaults of the ones that lack."""
    filled = {
        name: with_defaults(settings.get(name, {}), default)
        if isinstance(default, dict) and isinstance(settings.get(name, {}), dict)
        else settings.get(name, default)
        for name, default in defaults.items()
    }
    return settings | filled


def require_same_recipe(run: RunConfig, checkpoint: Checkpoint, path: str) -> None:
    """Raise InputError where a checkpoint was trained with other settings.

    A setting that it does not know is newer than it, and had its default.
    """
    # Through JSON, as in the checkpoint: tuples become lists.
    recipe, defaults = (json.loads(json.dumps(asdict(one))) for one in (run.recipe, Recipe()))
    trained = with_defaults(checkpoint.recipe, defaults)
    changed = sorted(name for name in recipe | trained if trained.get(name) != recipe.get(name))
    if changed:
        raise InputError(
            f"{path} was trained by recipe {checkpoint.recipe.get('name')} with another "
            f"{', '.join(changed)}; choose another "
            "--out, or the same recipe and settings to resume it"
        )


class CheckpointWriter:
    """Writes a run's checkpoints: last.pt always exists and is complete, the ones before it get
    names of their own.
    """

    def __init__(self, run: RunConfig, found: FoundCheckpoint) -> None:
        self._run = run
        # The name that last.pt gets when it is replaced; None where it was damaged.
        self._latest = (
            archive_name(found[1]) if found is not None and found[0] == CHECKPOINT_FILE else None
        )

    def write(self, checkpoint: Checkpoint) -> None:
        last = storage.join(self._run.out, CHECKPOINT_FILE)
        if self._latest is not None and self._run.keep > 1:
            storage.link_or_copy(last, storage.join(self._run.out, self._latest))
        storage.write_bytes(last, dumps(checkpoint))
        self._latest = archive_name(checkpoint)
        for name in list_archived(self._run.out)[self._run.keep - 1 :]:
            storage.remove(storage.join(self._run.out, name))


class RunRecorder:
    """Rank 0's records after steps and epochs: checkpoints, so that a kill costs little, and
    metrics.
    """

    def __init__(self, run: RunConfig, found: FoundCheckpoint) -> None:
        self._run, self._checkpoints = run, CheckpointWriter(run, found)
        self._metrics = MetricsLogger(run.out, [] if found is None else found[1].history)
        self._saved = time.monotonic()

    def after_step(self, checkpoint: Callable[[], Checkpoint]) -> None:
        """Within an epoch: write the checkpoint where it is due."""
        if time.monotonic() - self._saved >= 60 * self._run.checkpoint_minutes:
            self._write(checkpoint())

    def after_epoch(
        self, checkpoint: Callable[[], Checkpoint], history: list[dict[str, Any]]
    ) -> None:
        """After an epoch, whose row is the last of `history`."""
        epoch = len(history)
        # Before its checkpoint: on resume a row without a checkpoint is dropped, but an epoch
        # without its row would stay without it.
        self._metrics.write(history)
        if epoch % self._run.checkpoint_epochs == 0 or epoch == self._run.recipe.schedule.epochs:
            self._write(checkpoint())
        else:
            self.after_step(checkpoint)

    def _write(self, checkpoint: Checkpoint) -> None:
        self._checkpoints.write(checkpoint)
        self._saved = time.monotonic()

    def close(self) -> None:
        self._metrics.close()


class MetricsLogger:
    """The run's metrics to watch: RUN/metrics.jsonl, rewritten after each epoch, and TensorBoard
    where RUN is on a local disk.
    """

    def __init__(self, out: str, history: list[dict[str, Any]]) -> None:
        self._path = storage.join(out, METRICS_FILE)
        self._board: SummaryWriter | None = None
        # Rows that a killed run wrote after its last checkpoint are dropped, from both.
        if storage.exists(self._path):
            self._write(history)
        if storage.is_local(out):
            folder = storage.resolve(storage.join(out, "tensorboard"))[1]
            self._board = SummaryWriter(folder, purge_step=len(history) + 1)

    def write(self, history: list[dict[str, Any]]) -> None:
        self._write(history)
        if self._board is not None:
            row = history[-1]
            flat = {name: value for name, value in row.items() if isinstance(value, float)}
            flat |= {
                f"learning_rate/{group}": rate for group, rate in row["learning_rates"].items()
            }
            for name, value in flat.items():
                self._board.add_scalar(name, value, row["epoch"])
            self._board.flush()

    def _write(self, history: list[dict[str, Any]]) -> None:
        storage.write_bytes(self._path, "".join(json.dumps(row) + "\n" for row in history).encode())

    def close(self) -> None:
        if self._board is not None:
            self._board.close()
