"""The measurements of benchmarks/gpu.py: embedding and a training step of a network.

In: the name of a network, and sizes. Out: figures as plain values. Each is measured in a process of
its own: peak memory is the process's.
"""

import os
import platform
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import torch
from embed import random_encoder
from embedding_worker import (
    SOURCE_SIDE,
    MeasuredEmbedder,
    checkpoint,
    embed_job,
    encoder_spec,
    peak_memory_mb,
    recipe_of,
    soft_noise,
    write_shard,
)
from synthetic import jpegs
from train_step import time_steps

from jobs.encoding.settings import EncoderSettings
from jobs.training.recipes.builtin import builtin
from jobs.training.recipes.pvda import paper
from jobs.training.recipes.recipe import Recipe
from model.errors import CheckpointError
from model.inference.embed import embed
from model.inference.optimise import MIN_COSINE
from model.pvda import FeatureEncoder
from model.weights.start import load_start
from pipeline.features.embed_worker import IN_FLIGHT
from pipeline.shards.manifest import Shard

RECIPES = {"ResNet-50": paper, "built-in": builtin}
SHARDS = 4
"Tars of a round of embedding."
DISTINCT = 64
"Distinct images, which tars and training set repeat."
PROBES = 16
"Images that the parity is measured on."
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
MEMORY_OF = {"cuda": "torch's on the GPU", "cpu": "the process's"}


def hardware() -> str:
    """The machine and torch, in words."""
    cores = f"{os.cpu_count()} cores, torch {torch.__version__}"
    if DEVICE == "cuda":
        return f"{torch.cuda.get_device_name()}, {cores}"
    return f"CPU ({platform.machine()}), {cores}"


def network_recipe(network: str, width: float, size: int) -> Recipe:
    return recipe_of(RECIPES[network]().network.backbone, width, size)


def start_weights(recipe: Recipe) -> tuple[FeatureEncoder, str]:
    """The built-in encoder where it is of this network, else random weights; which of them."""
    encoder = FeatureEncoder(recipe.network).eval()
    try:
        load_start(encoder, recipe.network.backbone, "builtin", None)
    except CheckpointError:
        return random_encoder(recipe.network), "random"
    return encoder, "built-in"


def measure_embedding(
    network: str,
    *,
    width: float,
    size: int,
    batch: int | None,
    rounds: int,
    seconds: float,
    compiling: Any,
    decoders: int | None,
    **others: object,
) -> dict[str, Any]:
    """Images per second from tar to Parquet and of the bare encoder, alternating; parity."""
    batch = batch or (256 if DEVICE == "cuda" else 8)
    cores = os.cpu_count() or 1
    recipe = network_recipe(network, width, size)
    encoder, weights = start_weights(recipe)
    probes_B3HW = soft_noise(PROBES, size, seed=3)
    expected_BE = embed(encoder, probes_B3HW, recipe.augmentation.mirror)
    required = dict(MIN_COSINE)
    # Measure encoders below the required agreement as well; their lines say so.
    MIN_COSINE["bfloat16"] = -1
    images = jpegs(DISTINCT, SOURCE_SIDE, SOURCE_SIDE)
    with tempfile.TemporaryDirectory() as folder:
        settings = EncoderSettings(compiling=compiling)
        spec = encoder_spec(checkpoint(recipe, encoder), batch, folder, images, settings)
        job = embed_job(folder, batch, cores, decoders or max(1, cores - 1))
        embedder = MeasuredEmbedder(job, spec)
        embedder.start()
        found_BE = embedder.encode(probes_B3HW)
        embedder.resident_on_device(2 * batch)  # warm
        reset_peak_memory()
        rate = embedder.resident_on_device(4 * batch)
        each = max(2, round(rate * seconds / SHARDS / batch)) * batch
        shards = [write_shard(folder, number, images, each) for number in range(SHARDS)]
        stage, resident = list[float](), list[float]()
        for _ in range(rounds):
            resident.append(embedder.resident_on_device(SHARDS * each // 2))
            stage.append(stage_rate(embedder, shards))
            resident.append(embedder.resident_on_device(SHARDS * each // 2))
        fast = embedder.fast
    cosine_B = (found_BE.double() * expected_BE.double()).sum(1)
    worst, mean = float(cosine_B.min()), float(cosine_B.mean())
    judged = replace(fast, agreement=worst, mean_agreement=mean).judged_agreement
    return {
        "how": f"{fast.precision}, {fast.kind}, batches of {batch} at {size} px",
        "images_per_second": max(stage),
        "resident_images_per_second": max(resident),
        "cosine_worst": worst,
        "cosine_mean": mean,
        "refused": judged < required[fast.precision],
        "weights": weights,
        "peak_memory_mb": peak_memory_mb(DEVICE),
        "memory_of": MEMORY_OF[DEVICE],
    }


def stage_rate(embedder: MeasuredEmbedder, shards: list[Shard]) -> float:
    """Images per second from tar to Parquet, with as many shards in flight as in embed_gallery."""
    begin = time.perf_counter()
    with ThreadPoolExecutor(IN_FLIGHT) as pool:
        rows = sum(done.rows for done in pool.map(embedder.work, shards))
    return rows / (time.perf_counter() - begin)


def measure_training(
    network: str,
    *,
    width: float,
    size: int,
    train_batch: int | None,
    steps: int | None,
    rounds: int,
    compile_training: bool,
    **others: object,
) -> dict[str, Any]:
    """Images per second of training steps on streamed images and on a batch in memory."""
    batch = train_batch or (64 if DEVICE == "cuda" else 4)
    recipe = replace(network_recipe(network, width, size), batch_size=batch, start="random")
    reset_peak_memory()
    steps = steps or (30 if DEVICE == "cuda" else 3)
    found = time_steps(recipe, SOURCE_SIDE, steps, rounds, DEVICE, compile_training, DISTINCT)
    waiting = 100 * found.waiting / found.streamed
    return {
        "how": f"{batch} + {batch} at {size} px, waits for data {waiting:.1f} % of a step",
        "images_per_second": 2 * batch / found.streamed,
        "resident_images_per_second": 2 * batch / found.resident,
        "parts": found.parts,
        "peak_memory_mb": peak_memory_mb(DEVICE),
        "memory_of": MEMORY_OF[DEVICE],
    }


def reset_peak_memory() -> None:
    """Count the GPU's peak memory from here on."""
    if DEVICE == "cuda":
        torch.cuda.reset_peak_memory_stats()
