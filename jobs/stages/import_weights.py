"""Public weights as a checkpoint.

In: a torchvision ResNet's state dict, or that of LPN's, FSRA's, Sample4Geo's, MCCG's or QDFL's
public code. Out: a checkpoint that jobs/embed_gallery.py takes. The backbone, its size, the parts
and the numbers per part are read off the file.
"""

import hashlib
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from jobs.stages.settings import ImportWeightsSettings
from model.checkpoint import Checkpoint, dumps, loads
from model.config import PVDAConfig
from model.errors import CheckpointError
from model.pvda import FeatureEncoder
from model.weights.fsra import convert_fsra
from model.weights.load import TORCHVISION_HINT, infer_backbone, load_backbone, parse_state_dict
from model.weights.lpn import ConvertedWeights, convert_lpn
from model.weights.mccg import convert_mccg
from model.weights.qdfl import convert_qdfl
from model.weights.sample4geo import convert_sample4geo
from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.progress import console


def import_weights(settings: ImportWeightsSettings) -> str:
    """Write the checkpoint and return its path; an existing one of the same file is kept.

    Raises InputError or CheckpointError on unusable input.
    """
    if not storage.exists(settings.source):
        expected = EXPECTED[settings.kind]
        raise InputError(f"no weights at {settings.source}; expected {expected}")
    if storage.is_folder(settings.source):
        raise InputError(
            f"{settings.source} is a folder, expected a file of weights; name the file in it"
        )
    data = storage.read_bytes(settings.source)
    made_of = {
        "kind": settings.kind,
        "sha256": hashlib.sha256(data).hexdigest(),
        "image_size": settings.side,
    }
    out = storage.absolute(settings.out)
    if storage.exists(out):
        require_same_origin(out, made_of)
        console.print(f"{out} is complete: made of {settings.source}; nothing to do")
        return out
    try:
        state = parse_state_dict(data, settings.source)
        checkpoint = CONVERTERS[settings.kind](state, settings, made_of)
    except CheckpointError:
        raise
    except ValueError as error:  # a size that the network cannot have
        raise InputError(f"{settings.source}: {error}") from error
    storage.write_bytes(out, dumps(checkpoint))
    network = checkpoint.network
    console.print(
        f"{out}: {network.backbone}, {network.parts} parts of {network.part_dim} numbers, "
        f"{network.image_size} px, {len(checkpoint.locations)} locations"
    )
    return out


def require_same_origin(out: str, made_of: dict[str, Any]) -> None:
    """Raise InputError where `out` is anything but a checkpoint made of the same."""
    try:
        origin = loads(storage.read_bytes(out), out).recipe.get("made_of")
    except (CheckpointError, OSError):
        origin = None
    if origin != made_of:
        raise InputError(
            f"{out} is there and was not made of this file and image size; choose another --out"
        )


def from_torchvision(
    state: dict[str, Tensor], settings: ImportWeightsSettings, made_of: dict[str, Any]
) -> Checkpoint:
    """The paper's encoder before training: torchvision's backbone, a refinement of random numbers,
    no classifier.
    """
    backbone, width = infer_backbone(state, settings.source)
    network = PVDAConfig(backbone=backbone, width=width, image_size=settings.side)
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(0)  # the same file gives the same embeddings
        encoder = FeatureEncoder(network)
    load_backbone(encoder.backbone, state, settings.source)
    console.print(
        "the refinement of the rings is untrained: train before judging by the embeddings"
    )
    return make_checkpoint(network, {"encoder": encoder.state_dict()}, [], made_of)


def from_lpn(
    state: dict[str, Tensor], settings: ImportWeightsSettings, made_of: dict[str, Any]
) -> Checkpoint:
    """LPN's encoder and classifier."""
    converted = convert_lpn(state, settings.source, settings.side)
    if converted.left_out:
        console.print(f"{converted.left_out} is left out: LPN's backbone of street and web images")
    console.print(
        "taken as trained with stride 1 and average pooling; LPN's opts.yaml says whether it was"
    )
    names = unnamed(converted.locations)
    return make_checkpoint(converted.network, converted.modules, names, made_of)


def from_authors(
    convert: Callable[[dict[str, Tensor], str, int], ConvertedWeights],
    state: dict[str, Tensor],
    settings: ImportWeightsSettings,
    made_of: dict[str, Any],
) -> Checkpoint:
    """Encoder and classifier of a method's public code; Sample4Geo has no classifier."""
    converted = convert(state, settings.source, settings.side)
    if converted.left_out:
        console.print(f"{converted.left_out} is left out: the network of street images")
    names = unnamed(converted.locations) if converted.locations else []
    return make_checkpoint(converted.network, converted.modules, names, made_of)


def unnamed(locations: int) -> list[str]:
    """Names by number: the files have none. Training folders are numbered in the order of their
    names.
    """
    digits = len(str(locations - 1))
    return [f"unnamed-{number:0{digits}}" for number in range(locations)]


def make_checkpoint(
    network: PVDAConfig,
    modules: dict[str, dict[str, Tensor]],
    locations: list[str],
    made_of: dict[str, Any],
) -> Checkpoint:
    return Checkpoint(
        network=network,
        recipe={"name": f"imported from {made_of['kind']}", "made_of": made_of},
        locations=locations,
        epoch=0,
        history=[],
        state={"modules": modules},
    )


CONVERTERS: dict[str, Callable[..., Checkpoint]] = {
    "torchvision": from_torchvision,
    "lpn": from_lpn,
    "fsra": partial(from_authors, convert_fsra),
    "sample4geo": partial(from_authors, convert_sample4geo),
    "mccg": partial(from_authors, convert_mccg),
    "qdfl": partial(from_authors, convert_qdfl),
}
EXPECTED = {
    "torchvision": TORCHVISION_HINT,
    "lpn": "the net_*.pth of a training run of the LPN code",
    "fsra": "the net_*.pth of a training run of the FSRA code",
    "sample4geo": "the weights_*.pth of a training run of the Sample4Geo code",
    "mccg": "the net_*.pth of a training run of the MCCG code (mode-str/crossview)",
    "qdfl": "the .ckpt of a training run of the QDFL code",
}
"What a kind of weights is read from."
