"""ResNet without its classifier, with torchvision's state-dict names and layer4 kept at stride 1.

In: normalised images (B, 3, H, W). Out: feature maps (B, C, H/16, W/16); C is 2048 for ResNet-50
at full width.
"""

import re
from typing import ClassVar, Self

from torch import Tensor, nn

from model.backbones.base import MAX_CHANNELS, Backbone

MIN_CHANNELS = 16
"""Into a strided 1x1 shortcut. In the backward pass of a thinner one, channels last, oneDNN writes
past its memory on CPUs with AVX-512 (its issue 6035; seen with torch 2.13), and the process crashes
sooner or later."""


class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a shortcut (ResNet-18 and 34)."""

    expansion = 1

    def __init__(self, inside: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inside, width, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.relu1, self.relu2 = relus(2)
        self.downsample = shortcut(inside, width, stride)

    def forward(self, x: Tensor) -> Tensor:
        y = self.relu1(self.bn1(self.conv1(x)))
        y = self.bn2(self.conv2(y))
        z: Tensor = self.relu2(y + (x if self.downsample is None else self.downsample(x)))
        return z


class Bottleneck(nn.Module):
    """1x1, 3x3 (which carries the stride, as in torchvision), 1x1 and a shortcut (ResNet-50 and
    101).
    """

    expansion = 4

    def __init__(self, inside: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inside, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, width * self.expansion, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(width * self.expansion)
        self.relu1, self.relu2, self.relu3 = relus(3)
        self.downsample = shortcut(inside, width * self.expansion, stride)

    def forward(self, x: Tensor) -> Tensor:
        y = self.relu1(self.bn1(self.conv1(x)))
        y = self.relu2(self.bn2(self.conv2(y)))
        y = self.bn3(self.conv3(y))
        z: Tensor = self.relu3(y + (x if self.downsample is None else self.downsample(x)))
        return z


def relus(count: int) -> list[nn.ReLU]:
    """`count` modules: quantisers fuse each ReLU into its convolution, so none is shared."""
    return [nn.ReLU(inplace=True) for _ in range(count)]


def shortcut(inside: int, outside: int, stride: int) -> nn.Module | None:
    """The projection that a block needs where its input and output differ in shape."""
    if stride == 1 and inside == outside:
        return None
    return nn.Sequential(nn.Conv2d(inside, outside, 1, stride, bias=False), nn.BatchNorm2d(outside))


LAYOUTS: dict[str, tuple[type[BasicBlock | Bottleneck], tuple[int, int, int, int]]] = {
    "resnet18": (BasicBlock, (2, 2, 2, 2)),
    "resnet34": (BasicBlock, (3, 4, 6, 3)),
    "resnet50": (Bottleneck, (3, 4, 6, 3)),
    "resnet101": (Bottleneck, (3, 4, 23, 3)),
}
"The kind of block, and how many of them layer1 to layer4 have."


class ResNet(Backbone):
    """ResNet-18/34/50/101 up to layer4, `width` times as wide as published."""

    stride = 16  # layer4's own halving is removed (PVDA, section 3; LPN)
    mean, std = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet's, as torchvision trains
    foreign_names: ClassVar[dict[str, str]] = {}  # torchvision names them so too
    foreign_extra = ("fc.",)

    def __init__(self, name: str = "resnet50", width: float = 1.0) -> None:
        super().__init__()
        block, blocks = LAYOUTS[name]
        base = round(64 * width)
        self.channels = base * 8 * block.expansion
        self.conv1 = nn.Conv2d(3, base, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(base)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        inside = base
        # Stride 1 in layer4 reaches conv2 (conv1 in a BasicBlock) and downsample.0 of its first
        # block; no dilation.
        for number, (count, stride) in enumerate(zip(blocks, (1, 2, 2, 1), strict=True), start=1):
            layer_width = base * 2 ** (number - 1)
            layer = nn.Sequential()
            for position in range(count):
                layer.append(block(inside, layer_width, stride if position == 0 else 1))
                inside = layer_width * block.expansion
            self.add_module(f"layer{number}", layer)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def stages(self) -> list[list[nn.Module]]:
        """The stem, and layer1 to layer4."""
        layers = [self.get_submodule(f"layer{number}") for number in (1, 2, 3, 4)]
        return [[self.conv1, self.bn1, self.relu, self.maxpool], *([layer] for layer in layers)]

    @classmethod
    def build(cls, name: str, width: float) -> Self:
        """One of `LAYOUTS`. Raises ValueError for a width with too few or too many channels."""
        cls.require_width(name, width)
        return cls(name, width)

    @staticmethod
    def require_width(name: str, width: float) -> None:
        """Raise ValueError for a width with too few or too many channels."""
        # Channels that leave layer1 and enter the first strided shortcut.
        channels = round(64 * width) * LAYOUTS[name][0].expansion
        if channels < MIN_CHANNELS:
            raise ValueError(
                f"width is {width}, which gives layer1 of {name} {channels} channels; expected at "
                f"least {MIN_CHANNELS} (thinner ones crash oneDNN); use a larger width"
            )
        if channels > MAX_CHANNELS:
            raise ValueError(
                f"width is {width}, which gives layer1 of {name} {channels} channels; expected at "
                f"most {MAX_CHANNELS}; use a smaller width"
            )

    @classmethod
    def infer(cls, state: dict[str, Tensor]) -> tuple[str, float]:
        """Name and width of the ResNet that a state dict with torchvision's names belongs to.

        Raises ValueError that says which blocks it has where that is none of `LAYOUTS`.
        """
        positions = {
            tuple(map(int, found.groups()))
            for key in state
            if (found := re.match(r"layer(\d)\.(\d+)\.", key))
        }
        blocks = tuple(
            1 + max((block for at, block in positions if at == layer), default=-1)
            for layer in (1, 2, 3, 4)
        )
        bottleneck = any(re.match(r"layer\d\.\d+\.conv3\.", key) for key in state)
        conv1 = state.get("conv1.weight")
        if conv1 is not None and conv1.ndim == 4:
            for name, (block, counts) in LAYOUTS.items():
                if counts == blocks and bottleneck == (block is Bottleneck):
                    return name, len(conv1) / 64
        raise ValueError(
            f"conv1.weight is {'missing' if conv1 is None else 'there'}, layers 1 to 4 have "
            f"{', '.join(map(str, blocks))} {'bottleneck' if bottleneck else 'basic'} blocks"
        )
