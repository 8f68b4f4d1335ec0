"""The GAN trained, epoch by epoch, and all UAV images translated by it.

In: TranslateSettings. Out: OUT/generator.pt, from which a killed training resumes after its last
epoch; OUT/images in University-1652's layout; OUT/shards, to train and evaluate `pcl_style` on.
"""

import io
from collections import defaultdict
from dataclasses import asdict
from typing import Any

import torch

from jobs.training.loop import seed_dropout
from jobs.translation.images import write_images
from jobs.translation.settings import TranslateSettings
from model.translation import TranslationConfig, TranslationTraining
from model.weights import torch_files
from pipeline.batches.settings import StreamConfig
from pipeline.batches.training import TrainingStream
from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.lock import locks_output
from pipeline.core.progress import console, progress
from pipeline.images.augmentation import Augmentation
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.shards.shard_set import ShardSet, open_shards
from pipeline.sources.university1652 import University1652

GENERATOR_FILE = "generator.pt"


@locks_output(lambda settings: settings.out)
def translate(settings: TranslateSettings) -> str:
    """Train the GAN and translate the shards, or what of it is missing; returns the new shards.

    Raises InputError where OUT holds another translation.
    """
    shards = open_shards(storage.absolute(settings.shards))
    training = train_generator(settings, shards)
    images = storage.join(storage.absolute(settings.out), "images")
    write_images(shards, training, images, settings.batch_size)
    out = storage.join(settings.out, "shards")
    pack(University1652(), PackingSettings(root=images, out=out, workers=0))
    console.print(f"translated: {out}; train on it with jobs/train.py pcl_style --shards {out}")
    return out


def train_generator(settings: TranslateSettings, shards: ShardSet) -> TranslationTraining:
    """The trained networks; from the checkpoint, as far as it is."""
    path = storage.join(storage.absolute(settings.out), GENERATOR_FILE)
    torch.manual_seed(settings.seed)
    config = TranslationConfig(
        side=settings.side, channels=settings.channels, l1_weight=settings.l1_weight
    )
    training = TranslationTraining(config, "cuda" if torch.cuda.is_available() else "cpu")
    made_of = {name: value for name, value in asdict(settings).items() if name != "out"}
    history: list[dict[str, float]] = []
    if storage.exists(path):
        history = _resume(training, path, made_of)
    stream = TrainingStream(shards, stream_config(settings))
    left = (settings.epochs - len(history)) * stream.steps
    with progress(left, "translation", "steps") as meter:
        for epoch in range(len(history), settings.epochs):
            sums: defaultdict[str, float] = defaultdict(float)
            scale = min(1.0, 2 * (1 - epoch / settings.epochs))
            for step, (drone, satellite) in enumerate(stream.epoch(epoch)):
                seed_dropout(settings.seed, epoch, step, 0)
                taken = torch.from_numpy(drone.images_B3HW)
                real = torch.from_numpy(satellite.images_B3HW)
                for name, loss in training.step(taken, real, scale).items():
                    sums[name] += loss
                meter.advance(1)
            history.append({name: total / stream.steps for name, total in sums.items()})
            _save(training, path, made_of, history)
    if history:
        last = ", ".join(f"{name} {value:.3f}" for name, value in history[-1].items())
        console.print(f"{path}: {len(history)} epochs; {last}")
    return training


def stream_config(settings: TranslateSettings) -> StreamConfig:
    """Pairs of places, the UAV image laid on the ground, both mirrored together half the time."""
    return StreamConfig(
        batch_size=settings.batch_size,
        image_size=settings.side,
        perspective="overhead",
        augmentation=Augmentation(pad=0, rotation=0, mirror=False, pair_mirror=True),
        seed=settings.seed,
        sampler="paired",
    )


def _save(
    training: TranslationTraining,
    path: str,
    made_of: dict[str, Any],
    history: list[dict[str, float]],
) -> None:
    stream = io.BytesIO()
    torch.save({"made_of": made_of, "history": history, "state": training.state_dict()}, stream)
    storage.write_bytes(path, stream.getvalue())


def _resume(
    training: TranslationTraining, path: str, made_of: dict[str, Any]
) -> list[dict[str, float]]:
    """Load the checkpoint; returns the rows of its epochs. Raises InputError."""
    try:
        saved = torch_files.read(storage.read_bytes(path))
        history: list[dict[str, float]] = saved["history"]
        same = saved["made_of"] == made_of
        if same:
            training.load_state_dict(saved["state"])
    except Exception as error:  # torch raises many kinds over a damaged file
        raise InputError(
            f"{path} cannot be read ({type(error).__name__}), expected the checkpoint of a "
            "translation; delete it and run the same command again"
        ) from error
    if not same:
        raise InputError(
            f"{path} is of another translation, expected the same shards and settings; choose "
            "another --out"
        )
    return history
