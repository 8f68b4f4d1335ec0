"""What the benchmarks of embedding share: a worker with measurements, its tars, random encoders.

In: a recipe, JPEGs. Out: tars like those of jobs/make_shards.py, and a worker that embeds them.
Imports no Ray, so that benchmarks/gpu.py runs where Ray is not installed.
"""

import hashlib
import io
import json
import resource
import sys
import tarfile
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from jobs.encoding.encoder import WorkerEncoder, make_encoder_spec
from jobs.encoding.probe_images import CALIBRATION_IMAGES, PROBE_IMAGES
from jobs.encoding.settings import EncoderSettings
from jobs.training.recipes.builtin import builtin
from jobs.training.recipes.pvda import paper
from jobs.training.recipes.recipe import Recipe
from model.checkpoint import Checkpoint, dumps
from model.inference.embed import FastEncoder
from model.pvda import FeatureEncoder
from pipeline.core.records import Split, View
from pipeline.features.embed_worker import EmbedJob, EncoderSpec, ShardEmbedder
from pipeline.features.settings import EmbeddingSettings
from pipeline.shards.external import EXTERNAL
from pipeline.shards.manifest import Manifest, Shard
from pipeline.shards.shard_set import ShardSet

SOURCE_SIDE = 512
"Side of the images in the tars, pixels: University-1652's."


class MeasuredEmbedder(ShardEmbedder):
    """The worker, plus measurements of its encoder and its memory."""

    def resident(self, images: int) -> float:
        """Images per second of the encoder alone."""
        return self._device.submit(self._resident, images).result()

    def _resident(self, images: int) -> float:
        size, batch = self._spec.image_size, self._job.batch_size
        bytes_BHW3 = np.random.default_rng(0).integers(0, 256, (batch, size, size, 3), np.uint8)
        begin = time.perf_counter()
        for start in range(0, images, batch):
            self._encoder(bytes_BHW3[: images - start].transpose(0, 3, 1, 2))
        return images / (time.perf_counter() - begin)

    @property
    def fast(self) -> FastEncoder:
        """The encoder on its device; its callers are threads of this worker."""
        assert isinstance(self._encoder, WorkerEncoder)
        return self._encoder.fast

    def encode(self, images_B3HW: Tensor) -> Tensor:
        """Embeddings (B, E) as the stage computes them."""
        return torch.from_numpy(self._device.submit(self._encoder, images_B3HW.numpy()).result())

    def resident_on_device(self, images: int) -> float:
        """Images per second of the bare encoder on a batch in the device's memory: nothing is
        copied, and the device is waited for once, at the end.
        """
        return self._device.submit(self._resident_on_device, images).result()

    def _resident_on_device(self, images: int) -> float:
        size, batch = self._spec.image_size, self._job.batch_size
        batch_B3HW = soft_noise(1, size, seed=0).expand(batch, -1, -1, -1).to(self.fast.device)
        begin = time.perf_counter()
        for start in range(0, images, batch):
            embeddings_BE = self.fast(batch_B3HW[: images - start])
        embeddings_BE.cpu()  # waits for the device
        return images / (time.perf_counter() - begin)

    def peak(self) -> float:
        """Peak memory of this process in MB."""
        return peak_memory_mb("cpu")


def soft_noise(count: int, size: int, seed: int) -> Tensor:
    """Bytes (count, 3, size, size) of noise at several scales, channels last as in embedding."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.zeros(count, 3, size, size)
    for cells, weight in ((3, 0.5), (12, 0.3), (size, 0.2)):
        coarse = torch.rand(count, 3, cells, cells, generator=generator)
        image += F.interpolate(coarse, (size, size), mode="bicubic") * 255 * weight
    return image.clamp(0, 255).to(torch.uint8).to(memory_format=torch.channels_last)


def peak_memory_mb(device: str) -> float:
    """Peak memory in MB: on CUDA what torch has allocated, else what the process has resident."""
    if device == "cuda":
        return torch.cuda.max_memory_allocated() / 1e6
    scale = 1e6 if sys.platform == "darwin" else 1e3  # bytes there, kilobytes elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / scale


def recipe_of(backbone: str, width: float, size: int) -> Recipe:
    """The recipe that trains such a backbone, `width` times as wide, for images of `size` pixels.

    It sets rings and dimension of the embedding, and whether the mirror image is embedded as well.
    """
    recipe = builtin() if backbone.startswith("efficientnet") else paper()
    network = replace(recipe.network, backbone=backbone, width=width, image_size=size)
    return replace(recipe, network=network)


def checkpoint(recipe: Recipe, encoder: FeatureEncoder | None = None) -> bytes:
    """A checkpoint of `encoder`, by default one of random weights."""
    encoder = encoder or FeatureEncoder(recipe.network)
    return dumps(
        Checkpoint(
            network=recipe.network,
            recipe=asdict(recipe),
            locations=[],
            epoch=0,
            history=[],
            state={"modules": {"encoder": encoder.state_dict()}},
        )
    )


def write_shard(folder: str, number: int, images: list[bytes], count: int) -> Shard:
    """Write a tar of `count` images like those of jobs/make_shards.py; its manifest entry."""
    name = f"gallery-drone-{number:06d}"
    path = Path(folder) / f"{name}.tar"
    with tarfile.open(path, "w") as tar:
        for position in range(count):
            key = f"{name}-{position:06d}"
            metadata = {"key": key, "location": key, "view": "drone", "split": "gallery"}
            members = {
                "jpg": images[position % len(images)],
                "json": json.dumps(metadata | {"geotag": None}).encode(),
            }
            for suffix, data in members.items():
                member = tarfile.TarInfo(f"{key}.{suffix}")
                member.size = len(data)
                tar.addfile(member, io.BytesIO(data))
    data = path.read_bytes()
    return Shard(
        name=name,
        split=Split.GALLERY,
        view=View.DRONE,
        samples=count,
        bytes=len(data),
        sha256=hashlib.sha256(data).hexdigest(),
    )


def encoder_spec(
    weights: bytes,
    batch: int,
    folder: str,
    images: list[bytes],
    settings: EncoderSettings | None = None,
) -> EncoderSpec:
    """The encoder as a worker builds it; its probe images come from a separate shard."""
    probe_folder = Path(folder) / "probe"
    probe_folder.mkdir(exist_ok=True)
    write_shard(str(probe_folder), 0, images, PROBE_IMAGES + CALIBRATION_IMAGES)
    embedding = EmbeddingSettings(
        shards=str(probe_folder),
        out="none",
        split=Split.GALLERY,
        view=View.DRONE,
        batch_size=batch,
    )
    return make_encoder_spec(weights, "the benchmark's", embedding, settings)


def embed_job(folder: str, batch: int, threads: int, decoders: int) -> EmbedJob:
    """The work on tars of `folder`; parts go to `folder`/table."""
    return EmbedJob(
        shards=ShardSet(
            path=folder,
            manifest=Manifest(
                shards=(), classes=(), packing={"source": EXTERNAL, "scattered": []}, rejected=0
            ),
        ),
        out=f"{folder}/table",
        batch_size=batch,
        dtype="float32",
        threads=threads,
        decode_threads=decoders,
    )
