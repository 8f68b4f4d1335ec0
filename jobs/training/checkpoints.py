"""A training run and its folder: checkpoints that survive any kill, and curves for people.

In: a run's settings and state. Out: RUN/last.pt and the checkpoints before it, RUN/metrics.jsonl,
RUN/tensorboard.
"""

import json
import re
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from torch.utils.tensorboard import SummaryWriter

from jobs.training.recipes import Recipe
from model.checkpoint import Checkpoint, CheckpointError, dumps, loads
from pipeline.core import storage
from pipeline.core.errors import InputError

CHECKPOINT, CURVES = "last.pt", "metrics.jsonl"
BEFORE = {"resizer": "pillow"}
"""What a recipe did before it had that setting: a checkpoint from then goes on where the setting
says the same."""
OLDER = re.compile(r"checkpoint-(\d+)-(\d+)\.pt")


@dataclass(frozen=True, kw_only=True)
class Conduct:
    """How a run is carried out. Nothing of it changes what is trained, so a run may go on with
    another.
    """

    checkpoint_epochs: int = 1
    "A checkpoint is written at the end of every so many epochs, and of the last one."
    checkpoint_minutes: float = 10.0
    "And whenever so many minutes have passed since the last one, within an epoch too."
    keep: int = 2
    "Checkpoints that are kept: last.pt and the ones before it, which stand in where it is damaged."
    probe_epochs: int = 10
    "Epochs between two looks at the view gap and at the places held out; 0 never looks."
    compile: bool = False
    """Whether the networks are compiled by torch; where that fails, training says so and goes on
    without."""

    def __post_init__(self) -> None:
        for name in ("checkpoint_epochs", "keep"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}, expected at least 1")
        for name in ("checkpoint_minutes", "probe_epochs"):
            if getattr(self, name) < 0:
                raise InputError(f"{name} is {getattr(self, name)}, expected 0 or more")


@dataclass(frozen=True, kw_only=True)
class Run(Conduct):
    """One training run: what is trained on what, and where it is kept."""

    shards: str
    "Folder or URI of the shards, as every worker can open it."
    out: str
    "Folder or URI of the run, likewise."
    recipe: Recipe
    weights: str | None = None
    "State dict of torchvision's ResNet to start from."


def older_name(checkpoint: Checkpoint) -> str:
    """What a checkpoint is called once another is the last."""
    return f"checkpoint-{checkpoint.epoch:04d}-{checkpoint.step:05d}.pt"


def older_names(out: str) -> list[str]:
    """The checkpoints before the last one, newest first."""
    found = [match for name in storage.list_names(out) if (match := OLDER.fullmatch(name))]
    return [
        match[0]
        for match in sorted(found, key=lambda match: (int(match[1]), int(match[2])), reverse=True)
    ]


def find_checkpoint(
    run: Run, say: Callable[[str], None] = lambda word: None
) -> tuple[str, Checkpoint] | None:
    """Name and content of the run's newest checkpoint that can be read, if it has any; `say` is
    told of those that cannot.

    Raises InputError when it is of another recipe, CheckpointError when none of them can be read.
    """
    names = [
        name
        for name in (CHECKPOINT, *older_names(run.out))
        if storage.exists(storage.join(run.out, name))
    ]
    if names and names[0] != CHECKPOINT:
        say(f"{storage.join(run.out, CHECKPOINT)} is missing; taking {names[0]}, the one before it")
    for number, name in enumerate(names, start=1):
        path = storage.join(run.out, name)
        try:
            held = loads(storage.read_bytes(path), path)
        except CheckpointError as error:
            if number == len(names):
                raise
            say(f"{error}; taking {names[number]}, the one before it")
            continue
        refuse_other_recipe(run, held, path)
        return name, held
    return None


def read_checkpoint(run: Run) -> Checkpoint | None:
    """The run's newest checkpoint that can be read, if it has any. Raises as `find_checkpoint`
    does.
    """
    found = find_checkpoint(run)
    return None if found is None else found[1]


def refuse_other_recipe(run: Run, held: Checkpoint, path: str) -> None:
    # Through JSON, as the checkpoint has it: tuples become lists.
    recipe, trained = json.loads(json.dumps(asdict(run.recipe))), BEFORE | held.recipe
    changed = sorted(name for name in recipe | trained if trained.get(name) != recipe.get(name))
    if changed:
        raise InputError(
            f"{path} was trained by recipe {held.recipe.get('name')} with another {', '.join(changed)}; choose another --out, "
            "or the same recipe and settings to go on with it"
        )


class Checkpoints:
    """Writes a run's checkpoints: last.pt is always there and whole, the ones before it keep names
    of their own.
    """

    def __init__(self, run: Run, found: tuple[str, Checkpoint] | None) -> None:
        self._run = run
        # The name under which last.pt lives on; none where it was damaged.
        self._latest = (
            older_name(found[1]) if found is not None and found[0] == CHECKPOINT else None
        )

    def write(self, checkpoint: Checkpoint) -> None:
        last = storage.join(self._run.out, CHECKPOINT)
        if self._latest is not None and self._run.keep > 1:
            storage.link_or_copy(last, storage.join(self._run.out, self._latest))
        storage.write_bytes(last, dumps(checkpoint))
        self._latest = older_name(checkpoint)
        for name in older_names(self._run.out)[self._run.keep - 1 :]:
            storage.remove(storage.join(self._run.out, name))


class Keeper:
    """What rank 0 does when a step or an epoch is over, so that a kill costs little and people can
    watch.
    """

    def __init__(self, run: Run, found: tuple[str, Checkpoint] | None) -> None:
        self._run, self._checkpoints = run, Checkpoints(run, found)
        self._curves = Curves(run.out, [] if found is None else found[1].history)
        self._saved = time.monotonic()

    def step_over(self, now: Callable[[], Checkpoint]) -> None:
        """Within an epoch: write what `now` gives where it is time."""
        if time.monotonic() - self._saved >= 60 * self._run.checkpoint_minutes:
            self._write(now())

    def epoch_over(self, now: Callable[[], Checkpoint], history: list[dict[str, Any]]) -> None:
        """After an epoch, whose row is the last of `history`."""
        epoch = len(history)
        # Before its checkpoint: a row without one is dropped by the next run, an epoch without its
        # row would stay so.
        self._curves.write(history)
        if epoch % self._run.checkpoint_epochs == 0 or epoch == self._run.recipe.schedule.epochs:
            self._write(now())
        else:
            self.step_over(now)

    def _write(self, checkpoint: Checkpoint) -> None:
        self._checkpoints.write(checkpoint)
        self._saved = time.monotonic()

    def close(self) -> None:
        self._curves.close()


class Curves:
    """The run's curves for people: RUN/metrics.jsonl whole after each epoch, and TensorBoard where
    RUN is on a disk.
    """

    def __init__(self, out: str, history: list[dict[str, Any]]) -> None:
        self._path = storage.join(out, CURVES)
        self._board: SummaryWriter | None = None
        # What a killed run wrote after its last checkpoint is dropped, here and there.
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
