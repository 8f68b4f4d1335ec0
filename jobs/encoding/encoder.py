"""Builds the encoder of the embedding stage from a checkpoint: optimised, and checked against the
plain encoder.

In: a checkpoint's bytes, the settings of encoding, and some images of the shards. Out: an
EncoderSpec, with the fingerprint and the encoding that the feature table records.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch

from jobs.encoding.probe_images import CALIBRATION_IMAGES, PROBE_IMAGES, ImageBytes, first_images
from jobs.encoding.settings import Compiling, EncoderSettings
from model.checkpoint import Checkpoint, build_encoder, fingerprint, loads
from model.inference.int8 import PrecisionError, calibration_digest, require_int8
from model.inference.optimise import optimise_encoder
from model.inference.precision import (
    EffectivePrecision,
    Precision,
    describe_preprocessing,
    effective_precision,
)
from model.weights.builtin import BUILTIN, read_builtin
from pipeline.camera.pose import Perspective
from pipeline.core import storage
from pipeline.core.arrays import Floats
from pipeline.core.errors import InputError
from pipeline.core.progress import console
from pipeline.features.embed_worker import EncoderSpec
from pipeline.features.encoding import EncodingConfig
from pipeline.features.settings import EmbeddingSettings
from pipeline.features.table_writer import encoding_of_parts
from pipeline.images.transforms import preprocessing_name
from pipeline.shards.shard_set import ShardSet, open_or_scan

COMPILED: dict[Compiling, bool | Literal["auto"]] = {"auto": "auto", "always": True, "never": False}
"`compiled` of `optimise_encoder` by the setting."
INT8_PAYS_FROM = 4_096
"Images: quantising takes some 5 s, and saves half of the 3 ms of an image at the built-in size."


@dataclass(frozen=True, kw_only=True)
class EncoderRecipe:
    """What a worker builds an encoder from."""

    checkpoint: bytes
    encoding: EncodingConfig
    compiling: Compiling
    batch_size: int
    images: int
    "That each worker will embed, about."
    probe_B3HW: ImageBytes
    calibration_B3HW: ImageBytes | None


class WorkerEncoder:
    """An encoder, created and called on a worker. `remarks` are printed on the terminal."""

    def __init__(self, recipe: EncoderRecipe, threads: int) -> None:
        # Ray sets OMP_NUM_THREADS to the actor's cores before torch is imported; set again for
        # callers without Ray.
        torch.set_num_threads(threads)
        self.remarks: list[str] = []
        device = "cuda" if torch.cuda.is_available() else "cpu"
        encoder = build_encoder(loads(recipe.checkpoint)).to(
            device, memory_format=torch.channels_last
        )  # type: ignore[call-overload]
        calibration = recipe.calibration_B3HW
        self.fast = optimise_encoder(
            encoder,
            probe_B3HW=torch.from_numpy(recipe.probe_B3HW),
            batch_size=recipe.batch_size,
            precision=recipe.encoding.precision,
            mirror=recipe.encoding.mirror,
            compiled=COMPILED[recipe.compiling],
            images=recipe.images,
            calibration_B3HW=None if calibration is None else torch.from_numpy(calibration),
            log=self.remarks.append,
        )

    def __call__(self, images_B3HW: ImageBytes) -> Floats:
        embeddings_BD: Floats = self.fast(torch.from_numpy(images_B3HW)).cpu().numpy()
        return embeddings_BD


def read_checkpoint_bytes(path: str) -> bytes:
    """The bytes of a checkpoint, or of the built-in encoder.

    Raises InputError when there is none.
    """
    require_checkpoint(path)
    return read_builtin() if path == BUILTIN else storage.read_bytes(path)


def require_checkpoint(path: str) -> None:
    """Raise InputError where there is neither a file at `path` nor the built-in encoder meant."""
    if path != BUILTIN and not storage.is_file(path):
        raise InputError(
            f"no checkpoint at {path}; expected {BUILTIN}, or a last.pt of jobs/train.py; check "
            "--checkpoint"
        )


def absolute_checkpoint(path: str) -> str:
    """The checkpoint's path for a process in another folder; the built-in encoder's name stays."""
    return path if path == BUILTIN else storage.absolute(path)


def make_encoder_spec(
    data: bytes,
    name: str,
    embedding: EmbeddingSettings,
    settings: EncoderSettings | None = None,
    open_set: Callable[[], ShardSet] | None = None,
) -> EncoderSpec:
    """The spec of a checkpoint whose bytes were read from `name`.

    `open_set` opens the shards of `embedding`; it is called when the checkpoint has proved usable.
    Raises CheckpointError when the bytes are no checkpoint, InputError where the precision is not
    available or no image can be decoded.
    """
    settings = settings or EncoderSettings()
    checkpoint = loads(data, name)
    size = checkpoint.network.image_size
    shards = (
        open_set() if open_set else open_or_scan(embedding.shards, embedding.split, embedding.view)
    )
    total = sum(shard.samples for shard in shards.manifest.of(embedding.split, embedding.view))
    precision = _precision_of_workers(settings.precision, embedding, name == BUILTIN, total)
    count = PROBE_IMAGES + (CALIBRATION_IMAGES if precision == "int8" else 0)
    perspective = settings.perspective or trained_perspective(checkpoint)
    images_B3HW = first_images(shards, size, settings.resizer, count, perspective)
    calibration_B3HW = images_B3HW[PROBE_IMAGES:] if precision == "int8" else None
    encoding = EncodingConfig(
        mirror=trained_on_mirrors(checkpoint) if settings.mirror is None else settings.mirror,
        resizer=settings.resizer,
        precision=precision,
        calibration=digest_of(calibration_B3HW),
        perspective=perspective,
    )
    recipe = EncoderRecipe(
        checkpoint=data,
        encoding=encoding,
        compiling=settings.compiling,
        batch_size=embedding.batch_size,
        images=total // (embedding.workers or 1),
        probe_B3HW=images_B3HW[:PROBE_IMAGES],
        calibration_B3HW=calibration_B3HW,
    )
    return EncoderSpec(
        fingerprint=encoder_fingerprint(checkpoint, encoding),
        encoding=encoding,
        image_size=size,
        factory=partial(WorkerEncoder, recipe),
    )


def trained_on_mirrors(checkpoint: Checkpoint) -> bool:
    """Whether training mirrored images; imported weights, whose training is unknown, count so, as
    all public methods do."""
    augmentation = checkpoint.recipe.get("augmentation")
    return not isinstance(augmentation, dict) or augmentation.get("mirror") is not False


def trained_perspective(checkpoint: Checkpoint) -> Perspective:
    """How training saw UAV images; encoders of others see them as they were taken."""
    return "overhead" if checkpoint.recipe.get("perspective") == "overhead" else "as_taken"


def _precision_of_workers(
    asked: Precision, embedding: EmbeddingSettings, is_builtin: bool, images: int
) -> EffectivePrecision:
    """The precision that the workers will compute in. `auto`: that of the table's parts, if there
    are any; int8 for many images where the CPU multiplies it fast, by the built-in encoder, whose
    recall has been measured in it; else by the kind of device.

    Raises InputError where they cannot.
    """
    device = "cuda" if torch.cuda.is_available() or embedding.gpus_per_worker else "cpu"
    present = encoding_of_parts(embedding.out) if asked == "auto" else None
    many = is_builtin and device == "cpu" and images >= INT8_PAYS_FROM
    if asked == "auto" and not present:
        if not (many and has_int8()):
            return effective_precision(asked, device)
        console.print(
            f"the built-in encoder embeds {images:,} images in int8, which this CPU multiplies "
            "fast; photos are compared with them in float32; say --precision float32 for a gallery "
            "in float32"
        )
        return "int8"
    precision = present.precision if present else effective_precision(asked, device)
    if precision == "int8":
        try:
            require_int8(device)
        except PrecisionError as error:
            raise InputError(str(error)) from None
    return precision


def has_int8() -> bool:
    """Whether this machine embeds in int8."""
    try:
        require_int8("cpu")
    except PrecisionError:
        return False
    return True


def digest_of(calibration_B3HW: ImageBytes | None) -> str | None:
    """Names the images that calibrated int8."""
    if calibration_B3HW is None:
        return None
    return calibration_digest(torch.from_numpy(calibration_B3HW))


def encoder_fingerprint(checkpoint: Checkpoint, encoding: EncodingConfig) -> str:
    """Hash of all that an embedding depends on: weights, network and encoding."""
    preprocessing = f"{preprocessing_name(encoding.resizer)}, mirror {encoding.mirror}"
    if encoding.perspective != "as_taken":  # so that fingerprints from before stay as they were
        preprocessing += f", UAV images {encoding.perspective}"
    text = describe_preprocessing(preprocessing, encoding.precision, encoding.calibration)
    return fingerprint(checkpoint, text)
