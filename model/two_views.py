"""Encoder and classifier on a batch of each view, as training runs them.

In: UAV and satellite images as bytes (B, 3, H, W). Out: maps, embeddings and location logits of
each view. Shapes: B images of a view, H x W pixels or cells, C channels of the maps, P rings, D
numbers of a ring, L locations.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from model.config import PVDAConfig
from model.pvda import FeatureEncoder, LocationClassifier


class ViewOutput(NamedTuple):
    """What the networks make of one view's images."""

    maps_BCHW: Tensor
    g_BPD: Tensor
    dropped_BPD: Tensor
    "After the dropout that the classifier draws: what metric losses compare [FSRA]."
    logits_BPL: Tensor


class EncoderWithClassifier(nn.Module):
    """Encoder and classifier as one module: DDP expects one forward pass an iteration.

    The encoder runs once per view, so that BatchNorm's statistics are a view's own [LPN]; with
    `joint_bn` once on both, so that they are common. Only common ones match the running means that
    the encoder is tested with.
    """

    def __init__(self, config: PVDAConfig, locations: int, joint_bn: bool = False) -> None:
        super().__init__()
        self.joint_bn = joint_bn
        self.encoder = FeatureEncoder(config)
        self.classifier = LocationClassifier(config, locations)

    def forward(self, images1_B3HW: Tensor, images2_B3HW: Tensor) -> tuple[ViewOutput, ViewOutput]:
        """UAV and satellite images -> the outputs of each."""
        if self.joint_bn:
            count = len(images1_B3HW)
            maps_BCHW, g_BPD = self.encoder(torch.cat([images1_B3HW, images2_B3HW]))
            both = self._classify(maps_BCHW, g_BPD)
            return (
                ViewOutput(*(tensor[:count] for tensor in both)),
                ViewOutput(*(tensor[count:] for tensor in both)),
            )
        outputs = [self.encoder(images_B3HW) for images_B3HW in (images1_B3HW, images2_B3HW)]
        first, second = (self._classify(maps_BCHW, g_BPD) for maps_BCHW, g_BPD in outputs)
        return first, second

    def _classify(self, maps_BCHW: Tensor, g_BPD: Tensor) -> ViewOutput:
        dropped_BPD = self.classifier.dropout(g_BPD)
        return ViewOutput(maps_BCHW, g_BPD, dropped_BPD, self.classifier.classify(dropped_BPD))
