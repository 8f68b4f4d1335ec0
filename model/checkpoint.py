"""Weights and config in one file that `torch.load(..., weights_only=True)` reads: no code runs when
one is opened.

In: a run's state. Out: bytes, and from bytes the encoder they describe. Where the bytes are kept is
the caller's matter. torch.load compares none of the checksums that its zip has. So a checkpoint
ends with the hash of all its bytes, as the zip's comment, which torch and zip programs pass over;
of one from before there were seals the zip's checksums are compared.
"""

import dataclasses
import hashlib
import io
import json
import re
import zipfile
from typing import Any

import torch

from model.config import PVDAConfig
from model.errors import CheckpointError
from model.pvda import FeatureEncoder
from model.weights import torch_files

FORMAT = 1
CHECKSUM_PATTERN = re.compile(rb"pvda\.seal:([0-9a-f]{64}):pvda\.seal")
CHECKSUM_MARK = b"pvda.seal"
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
    "Epochs that are over."
    history: list[dict[str, Any]]
    "One row per epoch, as metrics.jsonl has them."
    state: dict[str, Any]
    "As `Training.state` gives it; only `modules` where a checkpoint is not meant to be trained on."
    step: int = 0
    "Steps taken of the epoch that is not over."
    running: dict[str, torch.Tensor] = dataclasses.field(default_factory=dict)
    "Sums of that epoch's measures over these steps."

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
    buffer.seek(-2, io.SEEK_END)  # the length of the zip's comment, which is none
    buffer.write(CHECKSUM_BYTES.to_bytes(2, "little"))
    digest = hashlib.sha256(buffer.getbuffer()).hexdigest().encode()
    buffer.write(b":".join([CHECKSUM_MARK, digest, CHECKSUM_MARK]))
    return buffer.getvalue()


def loads(data: bytes, name: str = "the checkpoint") -> Checkpoint:
    """The checkpoint that `dumps` made; `name` stands in the message when it is none.

    Raises CheckpointError.
    """
    check_integrity(data, name)
    try:
        plain = torch_files.read(data)
        if plain.pop("format") != FORMAT:
            raise ValueError("another format")
        network = PVDAConfig(**json.loads(plain.pop("network")))
        recipe, history = json.loads(plain.pop("recipe")), json.loads(plain.pop("history"))
        held = Checkpoint(network=network, recipe=recipe, history=history, **plain)
        _check_fields(held)
        return held
    # torch raises many kinds over a damaged file, struct.error and IndexError among them
    except Exception as error:
        raise CheckpointError(
            f"{name} is not a checkpoint of format {FORMAT} ({type(error).__name__}); expected a last.pt written by "
            "jobs/train.py; name that file"
        ) from error


def check_integrity(data: bytes, name: str) -> None:
    """Raise CheckpointError where the bytes of a checkpoint, or of any file of torch.save's, are
    not what was written.

    0.1 s per 100 MB. Of bytes that are no zip nothing is said.
    """
    view = memoryview(data)
    seal = CHECKSUM_PATTERN.fullmatch(view[-CHECKSUM_BYTES:])
    if seal is not None:
        whole = hashlib.sha256(view[:-CHECKSUM_BYTES]).hexdigest().encode() == seal[1]
        reason = "its bytes have not the hash at its end"
    elif CHECKSUM_MARK in data[-CHECKSUM_BYTES:]:
        whole, reason = False, "the hash at its end is damaged"
    elif data[:2] == b"PK":
        whole, reason = _zip_is_intact(data)
    else:
        return
    if not whole:
        raise CheckpointError(
            f"{name} is damaged ({reason}), expected the bytes that were written; copy it again from where it came from, name "
            "the checkpoint before it, or make it anew with jobs/train.py"
        )


def _zip_is_intact(data: bytes) -> tuple[bool, str]:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as held:
            torch_files.require_uncompressed(held, len(data))
            bad = held.testzip()
    except Exception as error:  # zipfile raises many kinds over a damaged directory
        return False, f"{type(error).__name__}"
    return bad is None, f"the checksum of {bad} in it is another"


def _check_fields(held: Checkpoint) -> None:
    """Raise ValueError where a field is of another type, or the weights are of another network than
    is said.

    The network is laid out without memory: one that says to be a million times as wide is not built
    to find out.
    """
    plain = (
        isinstance(held.recipe, dict)
        and isinstance(held.history, list)
        and all(isinstance(row, dict) for row in held.history)
        and isinstance(held.locations, list)
        and all(isinstance(location, str) for location in held.locations)
        and all(type(count) is int and count >= 0 for count in (held.epoch, held.step))
        and isinstance(held.running, dict)
        and all(isinstance(value, torch.Tensor) for value in held.running.values())
        and all(isinstance(module, dict) for module in held.state["modules"].values())
    )
    if not plain:
        raise ValueError("a field of another type")
    with torch.device("meta"):
        wanted = {
            name: tensor.shape for name, tensor in FeatureEncoder(held.network).state_dict().items()
        }
    if {name: tensor.shape for name, tensor in held.encoder_weights.items()} != wanted:
        raise ValueError("weights of another network")


def build_encoder(checkpoint: Checkpoint) -> FeatureEncoder:
    """The encoder with the checkpoint's weights, in evaluation mode."""
    encoder = FeatureEncoder(checkpoint.network)
    encoder.load_state_dict(checkpoint.encoder_weights)
    return encoder.eval()


def load_encoder(path: str) -> FeatureEncoder:
    """The encoder of a checkpoint on the local disk, in evaluation mode."""
    with open(path, "rb") as stream:
        return build_encoder(loads(stream.read(), path))


def fingerprint(checkpoint: Checkpoint, preprocessing: str) -> str:
    """Hash of all that an embedding depends on: weights, network and preprocessing; 64 hexadecimal
    digits.
    """
    digest = hashlib.sha256()
    digest.update(
        json.dumps([dataclasses.asdict(checkpoint.network), preprocessing], sort_keys=True).encode()
    )
    for name, tensor in sorted(checkpoint.encoder_weights.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.contiguous().flatten().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()
