"""Backbones: the convolutional part of the encoder, from normalised images to feature maps.

In: images (B, 3, H, W). Out: maps (B, C, H/stride, W/stride). A new backbone is one file here, with
a class derived from `Backbone`, and one line in `BACKBONES`. `PVDAConfig` names the backbone,
checkpoints carry that name, and `model/weights` reads foreign weights by the table of names that
the backbone brings along. Begin with `base.py`, then read `resnet.py`.
"""

BACKBONES: dict[str, str] = {
    "resnet18": "model.backbones.resnet:ResNet",
    "resnet34": "model.backbones.resnet:ResNet",
    "resnet50": "model.backbones.resnet:ResNet",
    "resnet101": "model.backbones.resnet:ResNet",
    "efficientnet_lite0": "model.backbones.efficientnet_lite:EfficientNetLite",
    "efficientnet_lite2": "model.backbones.efficientnet_lite:EfficientNetLite",
}
"""Module and class by the backbone's name. A name and not the class: command lines list the
backbones without loading torch."""
