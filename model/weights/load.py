"""Foreign weights -> ours: a torchvision ResNet's state dict loads into the backbone by name."""

import re
from collections.abc import Callable
from pathlib import Path

import safetensors.torch
from torch import Tensor, nn

from model.backbones.resnet import BLOCKS, Depth
from model.checkpoint import check_integrity
from model.errors import CheckpointError
from model.weights import torch_files

TORCHVISION_HINT = (
    "a state dict of torchvision's ResNet: on a machine with a network, "
    "torchvision.models.resnet50(weights='IMAGENET1K_V1').state_dict() saved with torch.save"
)
"What a backbone starts from, and where it comes from."


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
            f"{name} holds something else than tensors by name; expected a state dict; save model.state_dict() alone"
        )
    return state


def infer_backbone(state: dict[str, Tensor], name: str) -> tuple[Depth, float]:
    """Depth and width of the ResNet that a state dict with torchvision's names is of.

    Raises CheckpointError when it is of none that we build.
    """
    places = {
        tuple(map(int, found.groups()))
        for key in state
        if (found := re.match(r"layer(\d)\.(\d+)\.", key))
    }
    blocks = tuple(
        1 + max((block for at, block in places if at == layer), default=-1)
        for layer in (1, 2, 3, 4)
    )
    bottleneck = any(re.match(r"layer\d\.\d+\.conv3\.", key) for key in state)
    conv1 = state.get("conv1.weight")
    if conv1 is not None and conv1.ndim == 4:
        for depth in BLOCKS:
            if BLOCKS[depth] == blocks and bottleneck == (depth >= 50):
                return depth, len(conv1) / 64
    raise CheckpointError(
        f"{name} is of no ResNet that we build: conv1.weight is {'missing' if conv1 is None else 'there'}, layers 1 to 4 have "
        f"{', '.join(map(str, blocks))} {'bottleneck' if bottleneck else 'basic'} blocks, and the names begin with "
        f"{', '.join(list(state)[:3]) or 'nothing'}; expected torchvision's names and depth {', '.join(map(str, BLOCKS))}"
    )


def load_backbone(backbone: nn.Module, state: dict[str, Tensor], name: str) -> None:
    """Load a torchvision ResNet's state dict; its classifier `fc.*` is left out.

    Raises CheckpointError that lists the names which are missing, unexpected or of another shape.
    """
    given = {key: tensor for key, tensor in state.items() if not key.startswith("fc.")}
    load_renamed(
        backbone,
        given,
        f"{name} does not fit this backbone",
        "choose the depth that it was made for",
    )


def load_renamed(
    module: nn.Module,
    given: dict[str, Tensor],
    complaint: str,
    remedy: str,
    foreign: Callable[[str], str] = str,
) -> None:
    """Load `given` where its names and shapes are exactly the module's, each translated by
    `foreign`.

    Only BatchNorm's count of its batches may be missing: files from before it was counted have
    none, and nothing that we compute depends on it. Raises CheckpointError that lists everything
    else, by its foreign name.
    """
    held = module.state_dict()
    own = {foreign(key): tensor for key, tensor in held.items()}
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
    module.load_state_dict({key: given.get(foreign(key), tensor) for key, tensor in held.items()})
