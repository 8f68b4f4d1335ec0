"""Backbones: the convolutional part of the encoder, from normalised images to feature maps.

In: images (B, 3, H, W). Out: maps (B, C, H/stride, W/stride). A new backbone is one file here and
one line in `BACKBONES`; the file holds a `Backbone` and the two functions of `Family`. `PVDAConfig`
names the backbone, checkpoints carry that name, and `model/weights` reads foreign weights by the
table of names that the backbone brings along. Begin with `base.py`, then read `resnet.py`.
"""

BACKBONES: dict[str, str] = {
    "resnet18": "model.backbones.resnet",
    "resnet34": "model.backbones.resnet",
    "resnet50": "model.backbones.resnet",
    "resnet101": "model.backbones.resnet",
}
"""Module by the backbone's name. A module and not a class: command lines list the names without
loading torch."""
