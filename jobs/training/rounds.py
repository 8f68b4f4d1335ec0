"""Rounds of a training without labels: each begins with pseudo-labels by the encoder as it is then.

In: a worker's state at the beginning of an epoch. Out: the same state with the round's stream; by
rank 0 the file RUN/pseudo-labels-<round>.parquet. A round is a period of the schedule: alpha grows
and the rates restart with it. The checkpoint carries the round's pairs, so a run that was killed
within a round goes on with them, and writes the file again where it is missing or damaged.

Shapes: U UAV images, S satellite images, E numbers of an embedding.
"""

from collections.abc import Iterator
from itertools import islice

import numpy as np
import pyarrow as pa
import torch

from jobs.training.state import TrainingState, open_stream
from model.errors import CheckpointError
from model.inference.embed import embed
from pipeline.batches.ordered import Decoded, decode_samples, split_failed, stack
from pipeline.batches.pseudo_labels import (
    UNPAIRED,
    PseudoLabelledShards,
    mutual_neighbours,
    training_keys,
)
from pipeline.batches.training import TrainingStream
from pipeline.core import parquet, storage
from pipeline.core.arrays import Floats, Ints
from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.shards.shard_set import ShardSet, open_shards

IMAGES_AT_ONCE = 32
"Images that are embedded in one pass."
SCHEMA = pa.schema([pa.field(name, pa.string(), nullable=False) for name in ("drone", "satellite")])
"Of the table of a round's pairs: keys of images."


def labels_file(out: str, number: int) -> str:
    """Path of the pairs of a run's round, counted from 1."""
    return storage.join(out, f"pseudo-labels-{number:04d}.parquet")


def start_round(state: TrainingState, epoch: int) -> dict[str, float]:
    """Give the state the stream of the epoch's round, by new pairs where the round begins here.

    Returns the shares of the UAV and satellite images that are in pairs, for the epoch's row.
    Raises InputError where there are too few pairs for a batch or no image of a view can be
    decoded, CheckpointError where the checkpoint's pairs are not of these shards.
    """
    number = epoch // state.run.recipe.schedule.period
    fresh = state.pseudo_labels is None or state.pseudo_labels["round"] != number
    if fresh:
        pair_U = state.context.broadcast(pair_views(state) if state.context.rank == 0 else None)
        state.pseudo_labels = {"round": number, "satellite": torch.from_numpy(pair_U)}
    assert state.pseudo_labels is not None
    pair_U = state.pseudo_labels["satellite"].numpy()
    if fresh or not is_labelled(state.stream):
        satellite_of = name_pairs(state, pair_U)
        path = labels_file(state.run.out, number + 1)
        if state.context.rank == 0 and (fresh or not parquet.parquet_intact(path)):
            columns = [list(satellite_of), list(satellite_of.values())]
            parquet.write_table(path, pa.table(columns, schema=SCHEMA))
        state.stream = open_stream(state.run, state.context, satellite_of)
    paired_U = pair_U[pair_U != UNPAIRED]
    shares = {
        "pseudo_labels/drone": len(paired_U) / len(pair_U),
        "pseudo_labels/satellite": len(np.unique(paired_U)) / len(state.stream.classes),
    }
    if fresh:
        state.report({"note": describe(number, shares, len(paired_U))})
    return shares


def describe(number: int, shares: dict[str, float], pairs: int) -> str:
    drone, satellite = shares.values()
    return (
        f"round {number + 1}: {pairs} pseudo-pairs, with {drone:.0%} of the UAV images and "
        f"{satellite:.0%} of the satellite images"
    )


def name_pairs(state: TrainingState, pair_U: Ints) -> dict[str, str]:
    """The pairs by keys. Raises InputError where they are too few for a batch, CheckpointError
    where they are of other shards."""
    run, shards = state.run, open_shards(state.run.shards)
    drones, satellites = (training_keys(shards, view) for view in (View.DRONE, View.SATELLITE))
    if len(pair_U) != len(drones) or pair_U.max() >= len(satellites):
        raise CheckpointError(
            f"the checkpoint of {run.out} has pseudo-labels of {len(pair_U)} UAV images and "
            f"{run.shards} has {len(drones)}, expected the shards that it was trained on; name "
            "those, or choose another --out"
        )
    named = zip(drones, pair_U, strict=True)
    satellite_of = {drone: satellites[at] for drone, at in named if at != UNPAIRED}
    found = len(set(satellite_of.values()))
    least = run.recipe.batch_size if run.recipe.sampler == "unique_pairs" else 1
    if found < least:
        raise InputError(
            f"the encoder finds pairs for {found} of {len(satellites)} satellite images of "
            f"{run.shards}, expected at least {least} for one batch; set a smaller --batch-size or "
            "--pseudo-margin or larger --pseudo-neighbours, or start from other --weights"
        )
    return satellite_of


def is_labelled(stream: TrainingStream) -> bool:
    """Whether a stream has a round's labels, and not only counts images."""
    shards = stream.shards
    return isinstance(shards, PseudoLabelledShards) and shards.satellite_of is not None


def pair_views(state: TrainingState) -> Ints:
    """The satellite image (U,) of each UAV training image, as the rows of `training_keys`, by the
    encoder as it is now. Training is not changed by it."""
    recipe, shards = state.run.recipe, open_shards(state.run.shards)
    drones, satellites = (training_keys(shards, view) for view in (View.DRONE, View.SATELLITE))
    drone_N, drone_NE = embed_training(state, shards, View.DRONE, drones)
    satellite_M, satellite_ME = embed_training(state, shards, View.SATELLITE, satellites)
    found_N = mutual_neighbours(
        drone_NE, satellite_ME, recipe.pseudo_neighbours, recipe.pseudo_margin
    )
    pair_U = np.full(len(drones), UNPAIRED)
    pair_U[drone_N] = np.where(found_N == UNPAIRED, UNPAIRED, satellite_M[found_N])
    return pair_U


def embed_training(
    state: TrainingState, shards: ShardSet, view: View, keys: list[str]
) -> tuple[Ints, Floats]:
    """Rows (N,) of a view's training images in `keys`, and their embeddings (N, E), without
    augmentation; images that cannot be decoded are left out.

    Raises InputError where none can be decoded.
    """
    encoder = state.training.model.encoder
    row_of = {key: row for row, key in enumerate(keys)}
    images, mirror = read_images(state, shards, view), state.run.recipe.augmentation.mirror
    rows, embedded = list[int](), list[Floats]()
    was_training = encoder.training
    encoder.eval()
    while group := list(islice(images, IMAGES_AT_ONCE)):
        intact, _ = split_failed(group)
        if intact:
            pixels_B3HW = torch.from_numpy(stack([image for _, image in intact]))
            vectors_BE = embed(encoder, pixels_B3HW.to(state.training.device), mirror)
            rows += [row_of[sample.key] for sample, _ in intact]
            embedded.append(vectors_BE.cpu().numpy())
    encoder.train(was_training)
    if not rows:
        raise InputError(
            f"not one {view} training image of {shards.path} can be decoded, expected some; pack "
            "again"
        )
    return np.array(rows), np.concatenate(embedded)


def read_images(state: TrainingState, shards: ShardSet, view: View) -> Iterator[Decoded]:
    """A view's training images, resized as in testing; of each only key and bytes are used."""
    config = state.stream.config
    samples = (s for one in shards.manifest.of(Split.TRAIN, view) for s in shards.samples(one))
    return decode_samples(
        samples,
        config.image_size,
        config.threads,
        2 * IMAGES_AT_ONCE,
        config.resizer,
        config.perspective,
    )
