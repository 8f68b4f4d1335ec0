"""Foreign weights -> ours: a torchvision ResNet's state dict loads into the backbone by name."""

from pathlib import Path

import safetensors.torch
import torch
from torch import Tensor, nn

from model.checkpoint import CheckpointError


def read_state_dict(path: str) -> dict[str, Tensor]:
    """Tensors by name from a `.pth` or `.safetensors` file; no code runs when it is opened.

    Raises CheckpointError.
    """
    try:
        if Path(path).suffix == ".safetensors":
            return safetensors.torch.load_file(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise CheckpointError(
            f"no weights at {path}; expected a state dict of torchvision's ResNet: on a machine with a network, "
            "torchvision.models.resnet50(weights='IMAGENET1K_V1').state_dict() saved with torch.save"
        ) from None
    except Exception as error:  # torch and safetensors raise many kinds over a damaged file
        raise CheckpointError(
            f"{path} is no state dict ({type(error).__name__}); expected .pth or .safetensors"
        ) from error
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise CheckpointError(
            f"{path} holds something else than tensors by name; expected a state dict; save model.state_dict() alone"
        )
    return state


def load_backbone(backbone: nn.Module, state: dict[str, Tensor], name: str) -> None:
    """Load a torchvision ResNet's state dict; its classifier `fc.*` is left out.

    Raises CheckpointError that lists the names which are missing, unexpected or of another shape.
    """
    given = {key: tensor for key, tensor in state.items() if not key.startswith("fc.")}
    own = backbone.state_dict()
    wrong = [f"{key} is missing" for key in own if key not in given and not key.endswith("num_batches_tracked")]
    wrong += [f"{key} is unexpected" for key in given if key not in own]
    wrong += [
        f"{key} is {tuple(given[key].shape)} and not {tuple(own[key].shape)}"
        for key in own if key in given and given[key].shape != own[key].shape
    ]  # fmt: skip
    if wrong:
        raise CheckpointError(
            f"{name} does not fit this backbone: {'; '.join(wrong)}; choose the depth that it was made for"
        )
    backbone.load_state_dict(own | given)
