"""Public weights -> our networks: reading a file of weights, and loading it by a table of names.

In: a `.pth` or `.safetensors` file. Out: its tensors by name, the backbone that they belong to, and
a module that holds them. Each backbone brings its own table; LPN's is in `lpn.py`.
"""

import re
from collections.abc import Mapping
from pathlib import Path

import safetensors.torch
from torch import Tensor, nn

from model.backbones import BACKBONES
from model.backbones.base import Backbone, families
from model.checkpoint import check_integrity
from model.errors import CheckpointError
from model.weights import torch_files

TORCHVISION_HINT = (
    "a state dict of torchvision's ResNet: on a machine with a network, "
    "torchvision.models.resnet50(weights='IMAGENET1K_V1').state_dict() saved with torch.save"
)
"The weights that a backbone starts from, and where to get them."


def read_state_dict(path: str) -> dict[str, Tensor]:
    """Tensors by name from a `.pth` or `.safetensors` file on the local disk; no code runs when it
    is opened.

    Raises CheckpointError.
    """
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise CheckpointError(f"no weights at {path}; expected {TORCHVISION_HINT}") from None
    except OSError as error:
        raise CheckpointError(
            f"{path} is no state dict ({error}); expected .pth or .safetensors"
        ) from error
    return parse_state_dict(data, path)


def parse_state_dict(data: bytes, name: str) -> dict[str, Tensor]:
    """Tensors by name from the bytes of a file called `name`; `.safetensors` by its ending, else
    torch's own format.

    Raises CheckpointError.
    """
    check_integrity(data, name)
    try:
        if name.endswith(".safetensors"):
            return safetensors.torch.load(data)
        state = torch_files.read(data)
    except Exception as error:  # torch and safetensors raise many kinds over a damaged file
        raise CheckpointError(
            f"{name} is no state dict ({type(error).__name__}); expected .pth or .safetensors"
        ) from error
    if not isinstance(state, dict) or not all(
        isinstance(name, str) and isinstance(tensor, Tensor) for name, tensor in state.items()
    ):
        raise CheckpointError(
            f"{name} has other values than tensors by name; expected a state dict; save "
            "model.state_dict() alone"
        )
    return state


def infer_backbone(state: dict[str, Tensor], name: str) -> tuple[str, float]:
    """Name and width of the backbone that a public state dict from the file `name` belongs to.

    Raises CheckpointError when it is none of BACKBONES.
    """
    reasons = []
    for family in families():
        try:
            return family.infer(state)
        except ValueError as error:
            reasons.append(str(error))
    raise CheckpointError(
        f"{name} is of no backbone that we build: {'; '.join(reasons)}, and the names begin with "
        f"{', '.join(list(state)[:3]) or 'nothing'}; expected torchvision's names and one of "
        f"{', '.join(BACKBONES)}"
    )


def load_backbone(backbone: Backbone, state: dict[str, Tensor], name: str) -> None:
    """Load public weights by the backbone's table of foreign names; a classifier is left out.

    Raises CheckpointError that lists the names which are missing, unexpected or of another shape.
    """
    given = {
        key: tensor for key, tensor in state.items() if not key.startswith(backbone.foreign_extra)
    }
    load_renamed(
        backbone,
        given,
        f"{name} does not fit this backbone",
        "choose the --backbone that it was made for",
        backbone.foreign_names,
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
) -> None:
    """Load `given` where its names and shapes are exactly the module's, each renamed by
    `foreign_names`.

    Only BatchNorm's count of its batches may be missing: files from before it was counted have
    none, and nothing that we compute depends on it. Raises CheckpointError that lists everything
    else, by its foreign name.
    """
    state = module.state_dict()
    own = {rename(key, foreign_names): tensor for key, tensor in state.items()}
    wrong = [
        f"{key} is missing"
        for key in own
        if key not in given and not key.endswith("num_batches_tracked")
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
