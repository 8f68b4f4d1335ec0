"""Dense local features: the built-in encoder's early maps, described by a small head, for matching
photos with a map.

In: an image (H, W, 3). Out: a descriptor of unit length for each cell of STRIDE pixels. Shapes: C
channels, D numbers, N points. The head is learned by benchmarks/dense_features.py from the exact
views of simulated flights; the encoder is that of `--checkpoint builtin`, as it is.
"""

import numpy as np
import safetensors.torch
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from model.checkpoint import build_encoder, loads
from model.inference.fuse_batchnorm import fuse_batchnorm
from model.weights.builtin import read_builtin, read_dense_head

STRIDE = 8
"Pixels of the image per cell."
WIDTH, NUMBERS = 128, 64
"Channels within the head, and numbers of a descriptor."


class DenseHead(nn.Module):
    """Maps of stride 8 and 16 -> a descriptor of unit length per cell of stride 8."""

    def __init__(self, fine: int, coarse: int) -> None:
        super().__init__()
        self.fine, self.coarse = nn.Conv2d(fine, WIDTH, 1), nn.Conv2d(coarse, WIDTH, 1)
        self.mix = nn.Sequential(
            nn.ReLU(),
            nn.Conv2d(WIDTH, WIDTH, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(WIDTH, NUMBERS, 3, padding=1),
        )

    def forward(self, fine_1CHW: Tensor, coarse_1CHW: Tensor) -> Tensor:
        """(1, C, H, W) and (1, C, H / 2, W / 2) -> (1, D, H, W)."""
        up_1CHW = F.interpolate(self.coarse(coarse_1CHW), scale_factor=2, mode="bilinear")
        described_1DHW: Tensor = self.mix(self.fine(fine_1CHW) + up_1CHW)
        return F.normalize(described_1DHW, dim=1)


class DenseEncoder:
    """The built-in encoder's maps, and the head that describes them."""

    def __init__(self) -> None:
        """With a head of random weights. Raises CheckpointError where the encoder is missing."""
        encoder = build_encoder(loads(read_builtin(), "the built-in encoder"))
        self._encoder = fuse_batchnorm(encoder).to(  # type: ignore[call-overload]
            memory_format=torch.channels_last
        )
        fine, coarse = (maps.shape[1] for maps in self.maps(np.zeros((64, 64, 3), np.uint8)))
        self.head = DenseHead(fine, coarse).eval()

    @torch.no_grad()
    def maps(self, image_HW3: NDArray[np.uint8]) -> tuple[Tensor, Tensor]:
        """The last maps (1, C, H, W) of stride 8, and of stride 16 before the backbone's own head;
        the image is continued by its border to a multiple of 16."""
        encoder = self._encoder
        height, width = image_HW3.shape[:2]
        image_13HW = torch.from_numpy(image_HW3).permute(2, 0, 1)[None].float()
        padding = (0, -width % (2 * STRIDE), 0, -height % (2 * STRIDE))
        x = F.pad((image_13HW / 255 - encoder.mean_31) / encoder.std_31, padding, "replicate")
        x = x.contiguous(memory_format=torch.channels_last)
        side, last = x.shape[3], dict[int, Tensor]()
        for stage in encoder.backbone.stages()[:-1]:
            for layer in stage:
                x = layer(x)
            last[side // x.shape[3]] = x
        return last[STRIDE], last[2 * STRIDE]

    def describe(self, image_HW3: NDArray[np.uint8]) -> Tensor:
        """The descriptors (1, D, H / 8, W / 8) of an image, rounded up to whole cells."""
        described_1DHW: Tensor = self.head(*self.maps(image_HW3))
        return described_1DHW


def sample(described_1DHW: Tensor, points_N2: Tensor) -> Tensor:
    """Descriptors (N, D) of unit length at pixels (column, row) of the image, between its cells'
    middles by their distances."""
    extent_2 = torch.tensor(described_1DHW.shape[:1:-1]) * STRIDE
    grid_1N12 = (points_N2 / extent_2 * 2 - 1)[None, :, None].to(described_1DHW.dtype)
    found_1DN1 = F.grid_sample(
        described_1DHW, grid_1N12, align_corners=False, padding_mode="border"
    )
    return F.normalize(found_1DN1[0, :, :, 0].T, dim=1)


def load_dense() -> DenseEncoder:
    """With the head that comes with the project. Raises CheckpointError where it is missing."""
    dense = DenseEncoder()
    dense.head.load_state_dict(safetensors.torch.load(read_dense_head()))
    return dense
