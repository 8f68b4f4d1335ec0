"""Shards + checkpoint -> feature table: `embed_gallery.py --shards DIR --checkpoint FILE --out TABLE`."""

from dataclasses import dataclass, fields
from functools import partial

import numpy as np
import numpy.typing as npt
import torch

from jobs.cli import Failure, run
from model.checkpoint import build_encoder, fingerprint, loads
from model.inference import embed
from pipeline import storage
from pipeline.embed import EmbeddingSettings, Encoder, Incomplete, Network, embed_gallery
from pipeline.features import Floats
from pipeline.records import InputError
from pipeline.transforms import Resizer, preprocessing


@dataclass(frozen=True, kw_only=True)
class Settings(EmbeddingSettings):
    """Which shards are embedded, by which network, into which table."""

    checkpoint: str
    "A last.pt of jobs/train.py, or what jobs/import_weights.py wrote."
    mirror: bool = True
    "Whether the embeddings of an image and its mirror image are summed [LPN]."
    resizer: Resizer = "torch"
    "Whose bicubic resizes the images: torch's, or pillow's, which is faster on CPUs without AVX2; tables do not mix."


def make_encoder(data: bytes, mirror: bool, threads: int) -> Encoder:
    """The encoder of a checkpoint's bytes, on the GPU where there is one. Called on the worker."""
    # Ray sets OMP_NUM_THREADS to the actor's cores before torch is imported; said again for callers without Ray.
    torch.set_num_threads(threads)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    encoder = build_encoder(loads(data)).to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]

    def encode(images_B3HW: npt.NDArray[np.uint8]) -> Floats:
        result: Floats = embed(encoder, torch.from_numpy(images_B3HW).to(device), mirror).cpu().numpy()
        return result

    return encode


def network_of(data: bytes, name: str, mirror: bool = True, resizer: Resizer = "torch") -> Network:
    """What the embedder needs to know of a checkpoint.

    Raises CheckpointError when the bytes are none.
    """
    checkpoint = loads(data, name)
    return Network(
        fingerprint=fingerprint(checkpoint, f"{preprocessing(resizer)}, mirror {mirror}"),
        image_size=checkpoint.network.image_size,
        resizer=resizer,
        factory=partial(make_encoder, data, mirror),
    )


def main(settings: Settings) -> None:
    """Embed shards into a feature table, one part per shard; finished parts are skipped."""
    if not storage.exists(settings.checkpoint):
        raise InputError(
            f"no checkpoint at {settings.checkpoint}; expected a last.pt of jobs/train.py; check --checkpoint"
        )
    given = {field.name: getattr(settings, field.name) for field in fields(EmbeddingSettings)}
    given |= {"shards": storage.absolute(settings.shards), "out": storage.absolute(settings.out)}
    data = storage.read_bytes(settings.checkpoint)
    network = network_of(data, settings.checkpoint, settings.mirror, settings.resizer)
    try:
        embed_gallery(EmbeddingSettings(**given), network)
    except Incomplete as error:
        raise Failure(str(error)) from None


if __name__ == "__main__":
    run(main)
