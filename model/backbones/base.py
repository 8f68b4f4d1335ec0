"""What the encoder asks of a backbone, and how one is built by its name.

In: a name of `BACKBONES` and a width. Out: the module with its stride, channels, normalisation and
table of foreign names.
"""

from collections.abc import Sequence
from importlib import import_module
from typing import ClassVar, NamedTuple, Self

from torch import Tensor, nn

from model.backbones import BACKBONES

MAX_CHANNELS = 65_536
"Beyond any use; a checkpoint from elsewhere may name any width."


class Features(NamedTuple):
    """What a backbone makes of images."""

    maps_BCHW: Tensor
    token_BC: Tensor | None
    "The class token, of backbones that have one."


class Backbone(nn.Module):
    """Normalised images (B, 3, H, W) -> maps (B, C, H/stride, W/stride)."""

    stride: ClassVar[int]
    "Pixels of the image per cell of the maps."
    mean: ClassVar[tuple[float, float, float]]
    "Of red, green and blue in 0..1; subtracted from images before they come in."
    std: ClassVar[tuple[float, float, float]]
    "Likewise; images are divided by it."
    foreign_names: ClassVar[dict[str, str]]
    "Patterns of this module's tensor names -> the names in public weights; empty where they agree."
    foreign_extra: ClassVar[tuple[str, ...]]
    "Beginnings of names in public weights that this module has no use for, such as a classifier's."
    added: ClassVar[tuple[str, ...]] = ()
    "Beginnings of its own names that public weights lack: they keep their values at the start."
    loads_folders: ClassVar[bool] = False
    "Public weights come as a folder or by the hub's name (`load_pretrained`), not as one file."
    has_token: ClassVar[bool] = False
    "It has a class token beside the maps."
    quantizable: ClassVar[bool] = True
    "Its layers are those that 8-bit integers have been measured on: convolutions and BatchNorm."
    channels: int
    "C, the channels of the maps."
    frozen_stages = 0
    "How many of the first stages keep their weights in training; set by `freeze`."

    @classmethod
    def build(cls, name: str, width: float) -> Self:
        """The backbone of that name, `width` times as wide as published.

        Raises ValueError for a width that it cannot have.
        """
        raise NotImplementedError

    @classmethod
    def infer(cls, state: dict[str, Tensor]) -> tuple[str, float]:
        """Name and width of the backbone that a public state dict belongs to.

        Raises ValueError that says how the state dict differs from all of this class.
        """
        raise NotImplementedError

    def load_pretrained(self, source: str) -> None:
        """Load the public weights in a folder, or of a name on the hub (`hf:OWNER/NAME`).

        Raises CheckpointError. Only for classes with `loads_folders`.
        """
        raise NotImplementedError

    def adapt(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """A public state dict with the shapes of this backbone; as it is, for most."""
        return state

    def check_size(self, height: int, width: int) -> None:
        """Raise ValueError for images of a size that this backbone cannot take; most take any."""

    def stages(self) -> Sequence[Sequence[nn.Module]]:
        """The layers in the order of `forward`, in the groups that `freeze` counts."""
        raise NotImplementedError

    def forward(self, images_B3HW: Tensor) -> Tensor:
        """Normalised images (B, 3, H, W) -> maps (B, C, H/stride, W/stride).

        No gradient reaches frozen stages, up to the first layer in them that learns: nothing before
        it asks for one.
        """
        x = images_B3HW
        for layer in (layer for stage in self.stages() for layer in stage):
            x = layer(x)
        return x

    def features(self, images_B3HW: Tensor) -> Features:
        """Normalised images (B, 3, H, W) -> maps, and the class token where there is one."""
        return Features(self(images_B3HW), None)

    def freeze(self, count: int) -> None:
        """Keep the weights and BatchNorm statistics of the first `count` stages in training; a
        layer of them that is `added` has no public ones to keep, and learns.

        Raises ValueError where there are not so many.
        """
        stages = self.stages()
        if not 0 <= count <= len(stages):
            raise ValueError(
                f"frozen_stages is {count}, expected 0 to {len(stages)}, the stages of this "
                "backbone"
            )
        self.frozen_stages = count
        for layer in self._frozen_layers():
            layer.requires_grad_(False)
        self.train(self.training)

    def train(self, mode: bool = True) -> Self:
        """As every module's, but frozen stages stay in evaluation mode."""
        super().train(mode)
        for layer in self._frozen_layers():
            layer.eval()
        return self

    def _frozen_layers(self) -> list[nn.Module]:
        """The layers of the frozen stages, but for `added` ones."""
        own = [module for name, module in self.named_children() if name.startswith(self.added)]
        frozen = self.stages()[: self.frozen_stages]
        return [layer for stage in frozen for layer in stage if layer not in own]


def backbone_class(name: str) -> type[Backbone]:
    """The class of a name in `BACKBONES`."""
    module, _, kind = BACKBONES[name].partition(":")
    found: type[Backbone] = getattr(import_module(module), kind)
    return found


def backbone_classes() -> list[type[Backbone]]:
    """Each class of `BACKBONES` once."""
    return list(dict.fromkeys(map(backbone_class, BACKBONES)))


def build_backbone(name: str, width: float) -> Backbone:
    """The backbone of a name in `BACKBONES`. Raises ValueError as `Backbone.build` does."""
    return backbone_class(name).build(name, width)
