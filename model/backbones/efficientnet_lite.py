"""EfficientNet-Lite without its classifier, the last halving removed.

In: normalised images (B, 3, H, W). Out: feature maps (B, 1280, H/16, W/16). Lite leaves out
EfficientNet's squeeze-and-excitation and its Swish, which integers compute badly, and keeps stem
and head at one width (Tan and Le, arXiv 1905.11946; TensorFlow's reference code for Lite). Padding
is TensorFlow's: at stride 2 the bottom and the right get the odd pixel.
"""

import math
import re
from dataclasses import dataclass
from typing import ClassVar, Self

import torch.nn.functional as F
from torch import Tensor, nn

from model.backbones.base import MAX_CHANNELS, Backbone

STEM, HEAD = 32, 1280
"Channels after the first and after the last convolution, whatever the width."
EPSILON, MOMENTUM = 1e-3, 0.01
"Of BatchNorm, as the public weights were trained."
ROUND_TO = 8
"Channels are multiples of it."


@dataclass(frozen=True, kw_only=True)
class StageLayout:
    """A run of inverted bottlenecks of one size."""

    expansion: int
    channels: int
    "Channels out, at width 1."
    blocks: int
    "At depth 1."
    kernel: int
    stride: int
    "Of the first block."


STAGES = (
    StageLayout(expansion=1, channels=16, blocks=1, kernel=3, stride=1),
    StageLayout(expansion=6, channels=24, blocks=2, kernel=3, stride=2),
    StageLayout(expansion=6, channels=40, blocks=2, kernel=5, stride=2),
    StageLayout(expansion=6, channels=80, blocks=3, kernel=3, stride=2),
    StageLayout(expansion=6, channels=112, blocks=3, kernel=5, stride=1),
    StageLayout(expansion=6, channels=192, blocks=4, kernel=5, stride=1),  # published: 2
    StageLayout(expansion=6, channels=320, blocks=1, kernel=3, stride=1),
)
SCALES = {"efficientnet_lite0": (1.0, 1.0), "efficientnet_lite2": (1.1, 1.2)}
"Width and depth of the published networks, as multiples of STAGES."


class SameConv2d(nn.Conv2d):
    """A convolution without bias, padded as TensorFlow's SAME: ceil(n / stride) cells out of n."""

    def __init__(self, inside: int, outside: int, kernel: int, stride: int, groups: int) -> None:
        padding = kernel // 2 if stride == 1 else 0
        super().__init__(inside, outside, kernel, stride, padding, groups=groups, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        if self.stride[0] > 1:
            x = F.pad(x, (*self._padding(x.shape[3]), *self._padding(x.shape[2])))
        y: Tensor = super().forward(x)
        return y

    def _padding(self, cells: int) -> tuple[int, int]:
        stride, kernel = self.stride[0], self.kernel_size[0]
        total = max((math.ceil(cells / stride) - 1) * stride + kernel - cells, 0)
        return total // 2, total - total // 2


class ConvNorm(nn.Module):
    """Convolution and BatchNorm, followed by ReLU6 where `active`."""

    def __init__(
        self, inside: int, outside: int, kernel: int = 1, stride: int = 1, *,
        groups: int = 1, active: bool = True,
    ) -> None:  # fmt: skip
        super().__init__()
        self.conv = SameConv2d(inside, outside, kernel, stride, groups)
        self.norm = nn.BatchNorm2d(outside, eps=EPSILON, momentum=MOMENTUM)
        self.act = nn.ReLU6(inplace=True) if active else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.act(self.norm(self.conv(x)))
        return y


class InvertedBottleneck(nn.Module):
    """1x1 that widens, depthwise convolution, 1x1 that narrows; a shortcut where shapes agree."""

    def __init__(self, inside: int, outside: int, expansion: int, kernel: int, stride: int) -> None:
        super().__init__()
        width = inside * expansion
        self.expand = ConvNorm(inside, width) if expansion > 1 else nn.Identity()
        self.depthwise = ConvNorm(width, width, kernel, stride, groups=width)
        self.project = ConvNorm(width, outside, active=False)
        self.shortcut = stride == 1 and inside == outside

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.project(self.depthwise(self.expand(x)))
        return x + y if self.shortcut else y


class EfficientNetLite(Backbone):
    """EfficientNet-Lite0 or -Lite2, `width` times as wide as published."""

    stride = 16
    mean = (127 / 255, 127 / 255, 127 / 255)  # (x - 127) / 128, as the public weights were trained
    std = (128 / 255, 128 / 255, 128 / 255)
    foreign_names: ClassVar[dict[str, str]] = {
        r"stem\.conv\.": "_conv_stem.",
        r"stem\.norm\.": "_bn0.",
        r"head\.conv\.": "_conv_head.",
        r"head\.norm\.": "_bn1.",
        r"blocks\.(\d+)\.expand\.conv\.": r"_blocks.\1._expand_conv.",
        r"blocks\.(\d+)\.expand\.norm\.": r"_blocks.\1._bn0.",
        r"blocks\.(\d+)\.depthwise\.conv\.": r"_blocks.\1._depthwise_conv.",
        r"blocks\.(\d+)\.depthwise\.norm\.": r"_blocks.\1._bn1.",
        r"blocks\.(\d+)\.project\.conv\.": r"_blocks.\1._project_conv.",
        r"blocks\.(\d+)\.project\.norm\.": r"_blocks.\1._bn2.",
    }
    foreign_extra = ("_fc.",)

    def __init__(self, name: str = "efficientnet_lite0", width: float = 1.0) -> None:
        super().__init__()
        self.stem = ConvNorm(3, STEM, 3, 2)
        self.blocks = nn.ModuleList()
        self._runs: list[range] = []
        inside = STEM
        for layout, channels, count in scaled_stages(name, width):
            self._runs.append(range(len(self.blocks), len(self.blocks) + count))
            for position in range(count):
                stride = layout.stride if position == 0 else 1
                self.blocks.append(
                    InvertedBottleneck(inside, channels, layout.expansion, layout.kernel, stride)
                )
                inside = channels
        self.head = ConvNorm(inside, HEAD)
        self.channels = HEAD
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out")

    def stages(self) -> list[list[nn.Module]]:
        """The stem, the seven runs of blocks, the head."""
        runs = ([self.blocks[number] for number in run] for run in self._runs)
        return [[self.stem], *runs, [self.head]]

    @classmethod
    def build(cls, name: str, width: float) -> Self:
        """A network of SCALES. Raises ValueError for a width with too few or too many channels."""
        if not (width > 0 and STAGES[-1].channels * width <= MAX_CHANNELS / 6):
            raise ValueError(
                f"width is {width}, expected more than 0 and at most "
                f"{MAX_CHANNELS // 6 // STAGES[-1].channels} for {name}"
            )
        return cls(name, width)

    @classmethod
    def infer(cls, state: dict[str, Tensor]) -> tuple[str, float]:
        """Name and width of the network that a state dict with the public names belongs to.

        Raises ValueError that says how many blocks it has where that is none of SCALES.
        """
        blocks = {int(found[1]) for key in state if (found := re.match(r"_blocks\.(\d+)\.", key))}
        for name in SCALES:
            if len(blocks) == sum(count for _, _, count in scaled_stages(name, 1.0)):
                return name, 1.0
        raise ValueError(f"{len(blocks)} blocks called _blocks.N of an EfficientNet-Lite")


def scaled_stages(name: str, width: float) -> list[tuple[StageLayout, int, int]]:
    """Each of STAGES with its channels and its count of blocks."""
    wider, deeper = SCALES[name]
    last = len(STAGES) - 1
    return [
        (
            layout,
            round_channels(layout.channels * wider * width),
            layout.blocks if number in (0, last) else math.ceil(layout.blocks * deeper),
        )
        for number, layout in enumerate(STAGES)
    ]


def round_channels(channels: float) -> int:
    """The nearest multiple of ROUND_TO, never less than nine tenths of `channels`."""
    rounded = max(ROUND_TO, int(channels + ROUND_TO / 2) // ROUND_TO * ROUND_TO)
    return rounded + ROUND_TO if rounded < 0.9 * channels else rounded
