"""A checkpoint -> the network as the embedder's workers build it: fast, checked against the plain
one, in a stated precision.

In: a checkpoint's bytes, and some images of what is to be embedded. Out: a Network with its
fingerprint. The images are chosen by their place in the shards alone, so a run that is continued
has the same ones.
"""

from dataclasses import dataclass
from functools import partial
from itertools import islice

import numpy as np
import numpy.typing as npt
import torch

from jobs.encoding.settings import EncoderSettings
from model.checkpoint import build_encoder, fingerprint, loads
from model.inference.int8 import PrecisionError, calibration_digest, require_int8
from model.inference.optimise import optimise_encoder
from model.inference.precision import (
    EffectivePrecision,
    describe_preprocessing,
    effective_precision,
)
from pipeline.batches.ordered import CHANGED, decode_samples, stack
from pipeline.core import storage
from pipeline.core.arrays import Pixels
from pipeline.core.errors import InputError
from pipeline.features.embed import EncoderSpec
from pipeline.features.settings import EmbeddingSettings
from pipeline.features.table import Floats
from pipeline.images.decode import DecodeError
from pipeline.images.transforms import Resizer, preprocessing_name
from pipeline.shards.samples import Sample
from pipeline.shards.shard_set import ShardSet, open_or_scan

PROBE_IMAGES, CALIBRATION_IMAGES = 16, 128
"Images by which the fast encoder is checked, and by which int8 is calibrated."
Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class EncoderRecipe:
    """What a worker makes an encoder of."""

    checkpoint: bytes
    settings: EncoderSettings
    precision: EffectivePrecision
    batch_size: int
    images: int
    "That each worker will embed, about."
    probe_B3HW: Bytes
    calibration_B3HW: Bytes | None


def read_checkpoint_bytes(path: str) -> bytes:
    """The bytes of a checkpoint.

    Raises InputError when there is none.
    """
    if not storage.is_file(path):
        raise InputError(
            f"no checkpoint at {path}; expected a last.pt of jobs/train.py; check --checkpoint"
        )
    return storage.read_bytes(path)


class WorkerEncoder:
    """An encoder, made and called on a worker. `remarks` are told on the terminal."""

    def __init__(self, blueprint: EncoderRecipe, threads: int) -> None:
        # Ray sets OMP_NUM_THREADS to the actor's cores before torch is imported; said again for
        # callers without Ray.
        torch.set_num_threads(threads)
        self.remarks: list[str] = []
        device = "cuda" if torch.cuda.is_available() else "cpu"
        encoder = build_encoder(loads(blueprint.checkpoint)).to(
            device, memory_format=torch.channels_last
        )  # type: ignore[call-overload]
        calibration = blueprint.calibration_B3HW
        self._fast = optimise_encoder(
            encoder,
            probe_B3HW=torch.from_numpy(blueprint.probe_B3HW),
            batch_size=blueprint.batch_size,
            precision=blueprint.precision,
            mirror=blueprint.settings.mirror,
            compiled={"auto": "auto", "always": True, "never": False}[blueprint.settings.compiling],  # type: ignore[arg-type]
            images=blueprint.images,
            calibration_B3HW=None if calibration is None else torch.from_numpy(calibration),
            log=self.remarks.append,
        )

    def __call__(self, images_B3HW: Bytes) -> Floats:
        result: Floats = self._fast(torch.from_numpy(images_B3HW)).cpu().numpy()
        return result


def make_encoder_spec(
    data: bytes, name: str, embedding: EmbeddingSettings, settings: EncoderSettings | None = None
) -> EncoderSpec:
    """What the embedder needs to know of a checkpoint whose bytes came from `name`.

    Raises CheckpointError when the bytes are none, InputError where the precision cannot be had or
    no image can be decoded.
    """
    settings = settings or EncoderSettings()
    checkpoint = loads(data, name)
    device = "cuda" if torch.cuda.is_available() or embedding.gpus_per_worker else "cpu"
    precision = effective_precision(settings.precision, device)
    size = checkpoint.network.image_size
    if precision == "int8":
        try:
            require_int8(device)
        except PrecisionError as error:
            raise InputError(str(error)) from None
    # Once: of shards that others made it is a pass over all tars.
    shards = open_or_scan(embedding.shards, embedding.split, embedding.view)
    count = PROBE_IMAGES + (CALIBRATION_IMAGES if precision == "int8" else 0)
    some_B3HW = first_images(shards, size, settings.resizer, count)
    calibration_B3HW = some_B3HW[PROBE_IMAGES:] if precision == "int8" else None
    digest = (
        None if calibration_B3HW is None else calibration_digest(torch.from_numpy(calibration_B3HW))
    )
    said = describe_preprocessing(
        f"{preprocessing_name(settings.resizer)}, mirror {settings.mirror}", precision, digest
    )
    blueprint = EncoderRecipe(
        checkpoint=data,
        settings=settings,
        precision=precision,
        batch_size=embedding.batch_size,
        images=sum(shard.samples for shard in shards.manifest.of(embedding.split, embedding.view))
        // (embedding.workers or 1),
        probe_B3HW=some_B3HW[:PROBE_IMAGES],
        calibration_B3HW=calibration_B3HW,
    )
    return EncoderSpec(
        fingerprint=fingerprint(checkpoint, said),
        image_size=size,
        resizer=settings.resizer,
        factory=partial(WorkerEncoder, blueprint),
    )


def first_images(shards: ShardSet, size: int, resizer: Resizer, count: int) -> Bytes:
    """The first images of a set, from each split and view alike, as bytes (at most `count`, 3,
    size, size).

    Of the whole set, whatever of it is to be embedded: queries and gallery may be embedded one
    after the other into one table. Within a shard images stand in the order of their keys' hashes:
    its first ones are a fair sample. Raises InputError where none of them can be decoded, or one is
    not the image that was packed.
    """
    first = {
        (shard.split, shard.view): shard
        for shard in reversed(shards.manifest.shards)
        if shard.samples
    }
    found = []
    shards.require_tars(first.values())
    for shard in first.values():
        samples = shards.samples(shard)
        images = (
            usable_pixels(shards, *opened)
            for opened in decode_samples(samples, size, 1, 4, resizer)
        )
        found.append(
            list(islice((image for image in images if image is not None), -(-count // len(first))))
        )
    mixed = [group[place] for place in range(count) for group in found if place < len(group)][
        :count
    ]
    if not mixed:
        raise InputError(
            f"none of the first images of {shards.path} can be decoded, expected some to check the "
            "encoder by; see "
            "make_shards.py --verify, and pack again"
        )
    return stack(mixed)


def usable_pixels(shards: ShardSet, sample: Sample, image: Pixels | DecodeError) -> Pixels | None:
    """An image's pixels, None where it has none. Raises InputError where it is not the one that was
    packed.
    """
    if isinstance(image, DecodeError) and image.reason == CHANGED:
        raise InputError(
            f"image {sample.key} of {shards.path} is not the one that was packed, expected it to "
            "check the encoder by; "
            f"{shards.repair_hint}"
        )
    return None if isinstance(image, DecodeError) else image
