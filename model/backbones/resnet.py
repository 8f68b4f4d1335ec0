"""ResNet without its classifier, with torchvision's state-dict names and layer4 kept at stride 1.

In: normalised images (B, 3, H, W). Out: feature maps (B, C, H/16, W/16); C is 2048 for ResNet-50 at
full width.
"""

from typing import Literal

from torch import Tensor, nn

Depth = Literal[18, 34, 50, 101]
BLOCKS: dict[Depth, tuple[int, int, int, int]] = {
    18: (2, 2, 2, 2),
    34: (3, 4, 6, 3),
    50: (3, 4, 6, 3),
    101: (3, 4, 23, 3),
}
STRIDE = 16
"Pixels of the image per cell of the maps: layer4's own halving is removed (PVDA, section 3; LPN)."
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
    """So many modules, not one used so often: quantisers fuse a ReLU into its convolution by the
    module that it is.
    """
    return [nn.ReLU(inplace=True) for _ in range(count)]


def shortcut(inside: int, outside: int, stride: int) -> nn.Module | None:
    """The projection that a block needs where its input and output differ in shape."""
    if stride == 1 and inside == outside:
        return None
    return nn.Sequential(nn.Conv2d(inside, outside, 1, stride, bias=False), nn.BatchNorm2d(outside))


def layer1_channels(depth: Depth, width: float) -> int:
    """Channels that leave layer1 and enter the first strided shortcut."""
    return round(64 * width) * (BasicBlock if depth < 50 else Bottleneck).expansion


class ResNet(nn.Module):
    """ResNet-18/34/50/101 up to layer4, `width` times as wide as published."""

    def __init__(self, depth: Depth = 50, width: float = 1.0) -> None:
        super().__init__()
        block = BasicBlock if depth < 50 else Bottleneck
        base = round(64 * width)
        self.channels = base * 8 * block.expansion
        "C, the channels of the maps."
        self.conv1 = nn.Conv2d(3, base, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(base)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        inside = base
        # Stride 1 in layer4 reaches conv2 (conv1 in a BasicBlock) and downsample.0 of its first
        # block; no dilation.
        for number, (count, stride) in enumerate(
            zip(BLOCKS[depth], (1, 2, 2, 1), strict=True), start=1
        ):
            width_here = base * 2 ** (number - 1)
            layer = nn.Sequential()
            for position in range(count):
                layer.append(block(inside, width_here, stride if position == 0 else 1))
                inside = width_here * block.expansion
            self.add_module(f"layer{number}", layer)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, images_B3HW: Tensor) -> Tensor:
        x: Tensor = self.maxpool(self.relu(self.bn1(self.conv1(images_B3HW))))
        for name in ("layer1", "layer2", "layer3", "layer4"):
            x = self.get_submodule(name)(x)
        return x
