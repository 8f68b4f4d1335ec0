"""The settings of the networks and of their optimisation. Imports nothing heavy: the command line
offers them before torch is loaded, and a checkpoint carries them."""

from dataclasses import dataclass, fields
from typing import Literal

from model.backbones import BACKBONES
from model.parts import POOLINGS

MAX_IMAGE_SIZE, MAX_PART_DIM = 16_384, 65_536
"Beyond any use; a checkpoint from elsewhere may name any size."
Divisor = Literal["box", "ring"]
Neck = Literal["linear", "linear_ones", "norm"]
"""From a part to its embedding: Linear and BatchNorm as LPN initialises them, with BatchNorm's
weights at one [FSRA, MCCG], or LayerNorm alone [Sample4Geo]."""


@dataclass(frozen=True, kw_only=True)
class PVDAConfig:
    """Sizes of the networks. The defaults are the paper's at 256 px."""

    backbone: str = "resnet50"
    "Name in BACKBONES, such as resnet50 [paper], efficientnet_lite0 or dinov2_small."
    width: float = 1.0
    "Channels of the backbone as a multiple of the published ones [paper: 1]."
    image_size: int = 256
    "Side of the square images in pixels [paper: 256, 384]."
    pooling: str = "rings"
    "Name in POOLINGS: how maps become the parts of an image [paper: rings]."
    parts: int = 4
    "Parts P of an image: its square rings, as a rule [paper: 4]."
    ring_divisor: Divisor = "box"
    "What a ring's sum is divided by: the area of its `box` [LPN] or of the `ring`."
    neck: Neck = "linear"
    "From a part to its numbers [paper: linear]."
    part_dim: int = 512
    "Numbers D per part after its neck [paper: 512]."
    dropout: float = 0.75
    "Before the location classifier [paper, LPN]."
    discriminator_channels: int = 1024
    "Channels of the view discriminator's convolutions [paper, fig. 2]."

    def __post_init__(self) -> None:
        if self.backbone not in BACKBONES:
            raise ValueError(
                f"backbone is {self.backbone!r}, expected one of {', '.join(BACKBONES)}"
            )
        if self.pooling not in POOLINGS:
            raise ValueError(f"pooling is {self.pooling!r}, expected one of {', '.join(POOLINGS)}")
        for name, most in (
            ("image_size", MAX_IMAGE_SIZE),
            ("part_dim", MAX_PART_DIM),
            ("discriminator_channels", MAX_PART_DIM),
        ):
            if not 1 <= getattr(self, name) <= most:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 1 to {most}")
        if self.parts < 1:
            raise ValueError(f"parts is {self.parts}, expected at least 1")

    @property
    def embedding_dim(self) -> int:
        """Length of an image's embedding: P * D."""
        return self.parts * self.part_dim


@dataclass(frozen=True, kw_only=True)
class LossWeights:
    """What encoder and classifier minimise beside the adversary's term, as a weighted sum. The
    defaults are the paper's. A loss of weight 0 is not computed."""

    location_weight: float = 1.0
    "Weight of Eq. 1, the classification of locations [paper]."
    location_mean: bool = False
    "Average that loss over the parts [FSRA, MCCG, QDFL], in place of their sum [paper, LPN]."
    contrastive_weight: float = 0.0
    "Weight of symmetric InfoNCE between the views' embeddings [paper: none; Sample4Geo: 1]."
    temperature: float = 0.05
    "InfoNCE divides cosines by it [chosen]."
    learn_temperature: bool = False
    "Learn it, from that value on [Sample4Geo: from 0.07]."
    label_smoothing: float = 0.1
    "Share of InfoNCE's target that is spread over all rows [Sample4Geo]."
    triplet_weight: float = 0.0
    "Weight of the cross-view triplet loss [FSRA, MCCG: 1]."
    triplet_margin: float = 0.3
    "Its margin, of distances between vectors of length 1 [FSRA]."
    similarity_weight: float = 0.0
    "Weight of the multi-similarity loss on the last part [QDFL: 2]."
    kl_weight: float = 0.0
    "Weight of the Kullback-Leibler divergence between the views' locations [FSRA's option: 1]."
    js_weight: float = 0.0
    "Weight of QDFL's divergence of the views' locations from their mean [QDFL: 1]."
    alignment_weight: float = 0.0
    "Weight of the dense alignment of the views' maps [DAC: 0.6]."
    gates_weight: float = 0.0
    "Weight of the location loss of three more heads, MCCG's, that only training has [DAC: 0.1]."
    regions_weight: float = 0.0
    "Weight of the contrast of heat regions within each view [CAMP: 1]."

    def __post_init__(self) -> None:
        weights = {
            field.name: getattr(self, field.name)
            for field in fields(self)
            if field.name.endswith("_weight")
        }
        for name, weight in weights.items():
            if weight < 0:
                raise ValueError(f"{name} is {weight}, expected 0 (without this loss) or more")
        if not any(weights.values()):
            raise ValueError(
                "the weights of all losses are 0, expected one above 0; set --location-weight or "
                "--contrastive-weight"
            )
        if not (self.temperature > 0 and 0 <= self.label_smoothing < 1):
            raise ValueError(
                f"temperature is {self.temperature} and label_smoothing {self.label_smoothing}, "
                "expected more than 0, and a share below 1"
            )

    @property
    def needs_pairs(self) -> bool:
        """Whether a loss compares the views row by row: both rows then show one location."""
        return any(
            (
                self.contrastive_weight, self.kl_weight, self.js_weight, self.alignment_weight,
                self.regions_weight,
            )
        )  # fmt: skip


Precision = Literal["auto", "float32", "bfloat16"]
Start = Literal["random", "imagenet", "builtin"]
"Weights that a training starts from."


@dataclass(frozen=True, kw_only=True)
class Optimization:
    """How the weights are updated. The defaults are the paper's."""

    optimizer: Literal["sgd", "adamw"] = "sgd"
    """Of the encoder and classifier: SGD with Nesterov momentum [LPN], or AdamW for short runs from
    scratch."""
    backbone_lr: float = 0.001
    "Learning rate of the backbone [paper]."
    head_lr: float = 0.01
    "Learning rate of the rings' refinement [paper]."
    classifier_lr: float = 0.01
    "Learning rate of the location classifier [paper]."
    discriminator_lr: float = 0.002
    "Learning rate of D, whose optimizer is Adam [paper]."
    momentum: float = 0.9
    "Of SGD [LPN]."
    weight_decay: float = 5e-4
    "Of encoder and classifier [LPN]; D has none [chosen]."
    clip_value: float = 0.0
    "Largest value of a gradient's number, beyond which it is clipped [Sample4Geo: 100]; 0: none."
    frozen_stages: int = 0
    """Stages of the backbone, counted from the image, that keep their weights and BatchNorm
    statistics [paper: none]."""
