"""The encoder as embedding uses it: bytes of images in, unit vectors out.

`embed` is the reference; a FastEncoder computes the same faster. `optimise.py` builds it and checks
it against the reference.
Shapes: B images, P rings, D numbers per ring, E = P * D numbers of an embedding.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.inference.precision import EffectivePrecision
from model.pvda import FeatureEncoder

CompiledKind = Literal["compiled", "openvino"]
"By torch, or by OpenVINO."
EncoderKind = Literal["plain", "folded"] | CompiledKind


def unit_embedding(g_BPD: Tensor) -> Tensor:
    """Each ring's vector to length 1, divided by sqrt(P), concatenated: (B, P * D) of length 1
    [LPN].
    """
    parts = g_BPD.shape[1]
    unit_BPD: Tensor = F.normalize(g_BPD, dim=2) / parts**0.5
    return unit_BPD.flatten(1)


@torch.inference_mode()
def embed(encoder: FeatureEncoder, images_B3HW: Tensor, mirror: bool = True) -> Tensor:
    """Unit embeddings (B, P * D), float32, of images given as bytes (B, 3, H, W).

    With `mirror` the embeddings of an image and its mirror image are summed before they are
    normalised [LPN].
    """
    g_BPD: Tensor = encoder(images_B3HW)[1]
    if mirror:
        g_BPD = g_BPD + encoder(images_B3HW.flip(3))[1]
    return unit_embedding(g_BPD.float())


class MirroredEncoder(nn.Module):
    """Images as bytes -> unit embeddings in one pass; the mirror images are the second half of the
    batch.
    """

    def __init__(self, encoder: FeatureEncoder, mirror: bool, in_bfloat16: bool = False) -> None:
        super().__init__()
        self.encoder, self.mirror, self.in_bfloat16 = encoder, mirror, in_bfloat16

    def forward(self, images_B3HW: Tensor) -> Tensor:
        """Bytes (B, 3, H, W) -> (B, E), float32, of length 1."""
        both_B3HW = torch.cat([images_B3HW, images_B3HW.flip(3)]) if self.mirror else images_B3HW
        with torch.autocast(images_B3HW.device.type, torch.bfloat16, enabled=self.in_bfloat16):
            g_BPD: Tensor = self.encoder(both_B3HW)[1]
        g_BPD = g_BPD.float()
        if self.mirror:
            of_images_BPD, of_mirrored_BPD = g_BPD.chunk(2)  # by no number: a trace would keep it
            g_BPD = of_images_BPD + of_mirrored_BPD
        return unit_embedding(g_BPD)


@dataclass(frozen=True, kw_only=True)
class FastEncoder:
    """Images as bytes (B, 3, H, W), any B -> unit embeddings (B, E), float32, on the encoder's
    device.
    """

    kind: EncoderKind
    "Which implementation it is."
    precision: EffectivePrecision
    "Precision of its products; part of the fingerprint."
    agreement: float = 1.0
    "The least cosine between its embedding and the plain encoder's, over the probe images."
    mean_agreement: float = 1.0
    "The mean of these cosines."
    batch_size: int
    "Images of a pass; an image and its mirror image count as one."
    device: torch.device
    run: Callable[[Tensor], Tensor]
    "Embeds one batch."

    @property
    def judged_agreement(self) -> float:
        """The cosine that it is judged by: of the worst image in float32, else the mean, for which
        image is rounded badly is a matter of chance.
        """
        return self.agreement if self.precision == "float32" else self.mean_agreement

    def __call__(self, images_B3HW: Tensor) -> Tensor:
        # Never in inference mode, even within a caller's: the compiler treats such tensors as other
        # inputs and compiles again.
        with torch.inference_mode(False), torch.no_grad():
            return torch.cat(
                [self._one(part_B3HW) for part_B3HW in torch.split(images_B3HW, self.batch_size)]
            )

    def _one(self, images_B3HW: Tensor) -> Tensor:
        """A batch in new memory, whose strides are always the same; padded with black images for
        the compiled encoder.
        """
        count = len(images_B3HW)
        # At least one: OpenVINO takes no empty batch.
        rows = self.batch_size if self.kind == "compiled" else max(1, count)
        shape = (rows, *images_B3HW.shape[1:])
        batch_B3HW = torch.empty(
            shape, dtype=torch.uint8, device=self.device, memory_format=torch.channels_last
        )
        batch_B3HW[:count] = images_B3HW
        batch_B3HW[count:] = 0
        return self.run(batch_B3HW)[:count]
