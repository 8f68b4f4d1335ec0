"""Public weights -> our networks: reading a file of weights, and loading it by a table of names.

In: a `.pth` or `.safetensors` file. Out: its tensors by name, the backbone that they belong to, and
a module that holds them. Each backbone brings its own table; LPN's is in `lpn.py`.
"""

import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors.torch
from torch import Tensor, nn

from model.backbones import BACKBONES
from model.backbones.base import Backbone, backbone_classes
from model.checkpoint import check_integrity
from model.errors import CheckpointError
from model.weights import torch_files
from model.weights.unwrap import (
    check_finite,
    find_state_dict,
    prefix_variants,
    strip_torch_names,
)

TORCHVISION_HINT = (
    "a state dict of torchvision's ResNet: on a machine with a network, "
    "torchvision.models.resnet50(weights='IMAGENET1K_V1').state_dict() saved with torch.save"
)
"The weights that a backbone starts from, and where to get them."
FOREIGN_CLASS = re.compile(r"GLOBAL ([\w.]+)")
"The class in torch's message about an object that it does not unpickle."


def read_state_dict(path: str) -> dict[str, Tensor]:
    """Tensors by name from a `.pth` or `.safetensors` file on the local disk; no code runs when it
    is opened.

    Raises CheckpointError.
    """
    return parse_state_dict(read_weights_file(path), path)


def read_weights_file(path: str) -> bytes:
    """The bytes of a file of weights. Raises CheckpointError where it cannot be read."""
    try:
        return Path(path).read_bytes()
    except FileNotFoundError:
        raise CheckpointError(f"no weights at {path}; expected {TORCHVISION_HINT}") from None
    except OSError as error:
        raise CheckpointError(
            f"{path} is no state dict ({error}); expected .pth or .safetensors"
        ) from error


def parse_state_dict(data: bytes, name: str) -> dict[str, Tensor]:
    """Tensors by name from the bytes of a file called `name`; `.safetensors` by its ending, else
    torch's own format, also as checkpoints of Lightning and of training scripts wrap it.

    Prefixes that DataParallel and torch.compile add to the names are taken off. Raises
    CheckpointError; for a tensor with NaN or infinity by its name.
    """
    check_integrity(data, name)
    state = strip_torch_names(find_state_dict(_parse(data, name), name), name)
    check_finite(state, name)
    return state


def _parse(data: bytes, name: str) -> Any:
    try:
        if name.endswith(".safetensors"):
            return safetensors.torch.load(data)
        return torch_files.read(data)
    except pickle.UnpicklingError as error:
        if foreign := FOREIGN_CLASS.search(str(error)):
            raise CheckpointError(
                f"{name} holds an object of {foreign[1]}, which would run code when it is read; "
                "expected tensors alone; where the file is trusted, read it with "
                "torch.load(FILE, weights_only=False) and save its state dict with torch.save"
            ) from error
        raise _no_state_dict(name, error) from error
    except Exception as error:  # torch and safetensors raise many kinds over a damaged file
        raise _no_state_dict(name, error) from error


def _no_state_dict(name: str, error: Exception) -> CheckpointError:
    return CheckpointError(
        f"{name} is no state dict ({type(error).__name__}); expected .pth or .safetensors"
    )


def infer_backbone(state: dict[str, Tensor], name: str) -> tuple[str, float]:
    """Name and width of the backbone that a public state dict from the file `name` belongs to,
    whose names may share a prefix.

    Raises CheckpointError when it is none of BACKBONES.
    """
    for variant in prefix_variants(state):
        reasons = dict[str, None]()  # a set in order: classes may give the same
        for family in backbone_classes():
            try:
                return family.infer(variant)
            except ValueError as error:
                reasons[str(error)] = None
    raise CheckpointError(
        f"{name} is of no backbone that we build: {'; '.join(reasons)}, and the names begin with "
        f"{', '.join(list(state)[:3]) or 'nothing'}; expected torchvision's names and one of "
        f"{', '.join(BACKBONES)}"
    )


def load_backbone(backbone: Backbone, state: dict[str, Tensor], name: str) -> None:
    """Load public weights by the backbone's table of foreign names; a classifier is left out, and
    a prefix that all names share.

    Raises CheckpointError that lists the names which are missing, unexpected or of another shape.
    """
    own = {rename(key, backbone.foreign_names) for key in backbone.state_dict()}
    best = max(prefix_variants(state), key=lambda one: len(own & one.keys()))
    given = {
        key: tensor for key, tensor in best.items() if not key.startswith(backbone.foreign_extra)
    }
    load_renamed(
        backbone,
        backbone.adapt(given),
        f"{name} does not fit this backbone",
        "choose the --backbone that it was made for",
        backbone.foreign_names,
        backbone.added,
    )


def rename(name: str, foreign_names: Mapping[str, str]) -> str:
    """The foreign name of one of our tensors, by patterns that match the beginning of our names."""
    for pattern, foreign in foreign_names.items():
        name = re.sub(f"^{pattern}", foreign, name)
    return name


def load_renamed(
    module: nn.Module,
    given: dict[str, Tensor],
    complaint: str,
    remedy: str,
    foreign_names: Mapping[str, str],
    added: tuple[str, ...] = (),
) -> None:
    """Load `given` where its names and shapes are exactly the module's, each renamed by
    `foreign_names`.

    What may be missing: names that begin with one of `added`, and BatchNorm's count of its batches:
    files from before it was counted have none, and nothing that we compute depends on it. Raises
    CheckpointError that lists everything else, by its foreign name.
    """
    state = module.state_dict()
    own = {rename(key, foreign_names): tensor for key, tensor in state.items()}
    wrong = [
        f"{key} is missing"
        for key in own
        if key not in given
        and not key.endswith("num_batches_tracked")
        and not key.startswith(added)
    ]
    wrong += [f"{key} is unexpected" for key in given if key not in own]
    wrong += [
        f"{key} is {tuple(given[key].shape)} and not {tuple(own[key].shape)}"
        for key in own if key in given and given[key].shape != own[key].shape
    ]  # fmt: skip
    if wrong:
        raise CheckpointError(f"{complaint}: {'; '.join(wrong)}; {remedy}")
    module.load_state_dict(
        {key: given.get(rename(key, foreign_names), tensor) for key, tensor in state.items()}
    )
