"""Weights and config in one file that `torch.load(..., weights_only=True)` reads: opening one runs
no code.

In: a run's state. Out: bytes, and from bytes the encoder that they describe; callers decide where
the bytes are stored. torch.load compares none of the checksums in its zip, so a checkpoint ends
with the SHA-256 of all bytes before it, as the zip's comment, which torch and zip programs ignore.
In files of torch.save without that comment the zip's own checksums are compared.
"""

import dataclasses
import hashlib
import io
import json
import re
import zipfile
from functools import lru_cache
from typing import Any

import safetensors.torch
import torch

from model.config import PVDAConfig
from model.errors import CheckpointError, MissingLibrary
from model.pvda import FeatureEncoder
from model.shapes_alone import shapes_alone, weights_follow
from model.weights import torch_files

FORMAT = 2
"""Version of the fields. 2: the network names its backbone, the recipe has the settings' new names.
"""
CHECKSUM_MARK = b"pvda.sha256"
CHECKSUM_PATTERN = re.compile(rb"pvda\.sha256:([0-9a-f]{64}):pvda\.sha256")
CHECKSUM_BYTES = 2 * (len(CHECKSUM_MARK) + 1) + 64


@dataclasses.dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """A run at the end of an epoch, or within one."""

    network: PVDAConfig
    recipe: dict[str, Any]
    "The resolved config of the whole run, as plain values."
    locations: list[str]
    "Names of the classifier's outputs, in order."
    epoch: int
    "Completed epochs."
    history: list[dict[str, Any]]
    "One row per epoch, as in metrics.jsonl."
    state: dict[str, Any]
    "`Training.state_dict`; only `modules` in a checkpoint that no training resumes from."
    step: int = 0
    "Steps taken in the epoch that is not complete."
    metric_sums: dict[str, torch.Tensor] = dataclasses.field(default_factory=dict)
    "Sums of that epoch's metrics over these steps."

    @property
    def encoder_weights(self) -> dict[str, torch.Tensor]:
        weights: dict[str, torch.Tensor] = self.state["modules"]["encoder"]
        return weights


def dumps(checkpoint: Checkpoint) -> bytes:
    """The checkpoint as the bytes of a file."""
    plain = {
        field.name: getattr(checkpoint, field.name) for field in dataclasses.fields(checkpoint)
    }
    plain |= {"format": FORMAT, "network": json.dumps(dataclasses.asdict(checkpoint.network))}
    plain |= {name: json.dumps(plain[name]) for name in ("recipe", "history")}
    buffer = io.BytesIO()
    torch.save(plain, buffer)
    buffer.seek(-2, io.SEEK_END)  # the length of the zip's comment, which is empty
    buffer.write(CHECKSUM_BYTES.to_bytes(2, "little"))
    digest = hashlib.sha256(buffer.getbuffer()).hexdigest().encode()
    buffer.write(b":".join([CHECKSUM_MARK, digest, CHECKSUM_MARK]))
    return buffer.getvalue()


def dumps_encoder(checkpoint: Checkpoint) -> bytes:
    """The encoder alone as the bytes of a `.safetensors` file, matrices in float16: for sharing.

    No training resumes from it. Vectors, BatchNorm's among them, stay float32.
    """
    weights = {
        name: tensor.half() if tensor.is_floating_point() and tensor.dim() > 1 else tensor
        for name, tensor in checkpoint.encoder_weights.items()
    }
    metadata = {
        "format": str(FORMAT),
        "network": json.dumps(dataclasses.asdict(checkpoint.network)),
        "recipe": json.dumps(checkpoint.recipe),
        "epoch": str(checkpoint.epoch),
    }
    return safetensors.torch.save(
        {name: tensor.contiguous() for name, tensor in weights.items()}, metadata
    )


def _loads_encoder(data: bytes, name: str) -> Checkpoint:
    """The checkpoint of `dumps_encoder`: without classifier, discriminator and history."""
    try:
        metadata = json.loads(_safetensors_header(data))["__metadata__"]
        if metadata["format"] != str(FORMAT):
            raise ValueError(f"format {metadata['format']}")
        weights = {
            key: tensor.float() if tensor.is_floating_point() else tensor
            for key, tensor in safetensors.torch.load(data).items()
        }
        checkpoint = Checkpoint(
            network=PVDAConfig(**json.loads(metadata["network"])),
            recipe=json.loads(metadata["recipe"]),
            locations=[],
            epoch=int(metadata["epoch"]),
            history=[],
            state={"modules": {"encoder": weights}},
        )
        _check_fields(checkpoint)
    except MissingLibrary:
        raise
    except Exception as error:  # safetensors raises its own kinds over a damaged file
        raise CheckpointError(
            f"{name} is no encoder of format {FORMAT} ({type(error).__name__}); expected a "
            ".safetensors file written by jobs/export_weights.py; name that file"
        ) from error
    return checkpoint


def is_checkpoint(data: bytes) -> bool:
    """Whether these are the bytes of a checkpoint of ours, and not of public weights."""
    return CHECKSUM_MARK in data[-CHECKSUM_BYTES:] or b'"network"' in _safetensors_header(data)


def _safetensors_header(data: bytes) -> bytes:
    """The JSON at the start of a safetensors file; empty for other files."""
    length = int.from_bytes(data[:8], "little")
    return data[8 : 8 + length] if data[8:9] == b"{" and length < len(data) else b""


def loads(data: bytes, name: str = "the checkpoint") -> Checkpoint:
    """The checkpoint that `dumps` or `dumps_encoder` wrote; error messages call it `name`.

    Raises CheckpointError.
    """
    if _safetensors_header(data):
        return _loads_encoder(data, name)
    check_integrity(data, name)
    try:
        plain = torch_files.read(data)
        version = plain.pop("format")
        if version == FORMAT:
            network = PVDAConfig(**json.loads(plain.pop("network")))
            recipe, history = json.loads(plain.pop("recipe")), json.loads(plain.pop("history"))
            checkpoint = Checkpoint(network=network, recipe=recipe, history=history, **plain)
            _check_fields(checkpoint)
            return checkpoint
    except MissingLibrary:
        raise
    # torch raises many kinds over a damaged file, struct.error and IndexError among them
    except Exception as error:
        raise CheckpointError(
            f"{name} is not a checkpoint of format {FORMAT} ({type(error).__name__}); expected a "
            "last.pt written by jobs/train.py; name that file"
        ) from error
    if version == FORMAT - 1 and type(version) is int:
        raise CheckpointError(
            f"{name} is a checkpoint of format {version}, expected format {FORMAT}, in which "
            "settings have other names; train again with jobs/train.py, or import the weights "
            "again with jobs/import_weights.py"
        )
    raise CheckpointError(
        f"{name} is not a checkpoint of format {FORMAT} (it names another format); expected a "
        "last.pt written by jobs/train.py; name that file"
    )


def check_integrity(data: bytes, name: str) -> None:
    """Raise CheckpointError where the bytes of a checkpoint, or of any file of torch.save, do not
    match their checksums.

    0.1 s per 100 MB. Bytes that are no zip pass.
    """
    view = memoryview(data)
    checksum = CHECKSUM_PATTERN.fullmatch(view[-CHECKSUM_BYTES:])
    if checksum is not None:
        intact = hashlib.sha256(view[:-CHECKSUM_BYTES]).hexdigest().encode() == checksum[1]
        reason = "its bytes do not match the checksum at its end"
    elif CHECKSUM_MARK in data[-CHECKSUM_BYTES:]:
        intact, reason = False, "the checksum at its end is damaged"
    elif data[:2] == b"PK":
        intact, reason = _zip_is_intact(data)
    else:
        return
    if not intact:
        raise CheckpointError(
            f"{name} is damaged ({reason}), expected the bytes that were written; copy it again "
            "from where it came from, name the checkpoint before it, or make it anew with "
            "jobs/train.py"
        )


def _zip_is_intact(data: bytes) -> tuple[bool, str]:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            torch_files.require_uncompressed(archive, len(data))
            bad = archive.testzip()
    except Exception as error:  # zipfile raises many kinds over a damaged directory
        return False, f"{type(error).__name__}"
    return bad is None, f"{bad} in it does not match its checksum"


def _check_fields(checkpoint: Checkpoint) -> None:
    """Raise ValueError where a field has another type, or the weights do not fit the network.

    The network is laid out without memory: a config may claim any size.
    """
    plain = (
        isinstance(checkpoint.recipe, dict)
        and isinstance(checkpoint.history, list)
        and all(isinstance(row, dict) for row in checkpoint.history)
        and isinstance(checkpoint.locations, list)
        and all(isinstance(location, str) for location in checkpoint.locations)
        and all(type(count) is int and count >= 0 for count in (checkpoint.epoch, checkpoint.step))
        and isinstance(checkpoint.metric_sums, dict)
        and all(isinstance(value, torch.Tensor) for value in checkpoint.metric_sums.values())
        and all(isinstance(module, dict) for module in checkpoint.state["modules"].values())
    )
    if not plain:
        raise ValueError("a field of another type")
    found = {name: tensor.shape for name, tensor in checkpoint.encoder_weights.items()}
    if found != _weight_shapes(checkpoint.network):
        raise ValueError("weights of another network")


@lru_cache(maxsize=4)
def _weight_shapes(network: PVDAConfig) -> dict[str, torch.Size]:
    """The shapes of an encoder's weights by name."""
    with shapes_alone():
        weights = FeatureEncoder(network).state_dict()
    return {name: tensor.shape for name, tensor in weights.items()}


def build_encoder(checkpoint: Checkpoint) -> FeatureEncoder:
    """The encoder with the checkpoint's weights, in evaluation mode."""
    with weights_follow():
        encoder = FeatureEncoder(checkpoint.network)
    encoder.load_state_dict(checkpoint.encoder_weights)
    return encoder.eval()


def load_encoder(path: str) -> FeatureEncoder:
    """The encoder of a checkpoint on the local disk, in evaluation mode."""
    with open(path, "rb") as stream:
        return build_encoder(loads(stream.read(), path))


ADDED_SETTINGS = ("pooling", "neck")
"""Of PVDAConfig, since format 2: at their defaults they are left out of the fingerprint, so that
features and indexes from before stay those of the same encoder."""


def fingerprint(checkpoint: Checkpoint, preprocessing: str) -> str:
    """Hash of all that an embedding depends on, 64 hexadecimal digits: weights, network,
    preprocessing."""
    digest, defaults = hashlib.sha256(), dataclasses.asdict(PVDAConfig())
    network = {
        name: value
        for name, value in dataclasses.asdict(checkpoint.network).items()
        if name not in ADDED_SETTINGS or value != defaults[name]
    }
    digest.update(json.dumps([network, preprocessing], sort_keys=True).encode())
    for name, tensor in sorted(checkpoint.encoder_weights.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.contiguous().flatten().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()
