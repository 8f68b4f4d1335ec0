"""The encoder as embedding uses it: bytes of images in, unit vectors out.

Shapes: B images, P rings, D numbers per ring.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from model.pvda import FeatureEncoder


def unit_embedding(g_BPD: Tensor) -> Tensor:
    """Each ring's vector to length 1, divided by sqrt(P), concatenated: (B, P * D) of length 1 [LPN]."""
    parts = g_BPD.shape[1]
    unit_BPD: Tensor = F.normalize(g_BPD, dim=2) / parts**0.5
    return unit_BPD.flatten(1)


@torch.inference_mode()
def embed(encoder: FeatureEncoder, images_B3HW: Tensor, mirror: bool = True) -> Tensor:
    """Unit embeddings (B, P * D), float32, of images given as bytes (B, 3, H, W).

    With `mirror` the embeddings of an image and its mirror image are summed before they are normalised [LPN].
    """
    g_BPD: Tensor = encoder(images_B3HW)[1]
    if mirror:
        g_BPD = g_BPD + encoder(images_B3HW.flip(3))[1]
    return unit_embedding(g_BPD.float())
