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
    "resnet18_usam": "model.backbones.usam:ResNetUSAM",
    "resnet50_usam": "model.backbones.usam:ResNetUSAM",
    "efficientnet_lite0": "model.backbones.efficientnet_lite:EfficientNetLite",
    "efficientnet_lite2": "model.backbones.efficientnet_lite:EfficientNetLite",
    "efficientnet_lite0_usam": "model.backbones.usam:EfficientNetLiteUSAM",
    "vit_small": "model.backbones.huggingface:ViT",
    "vit_base": "model.backbones.huggingface:ViT",
    "dinov2_small": "model.backbones.huggingface:DINOv2",
    "dinov2_base": "model.backbones.huggingface:DINOv2",
    "dinov3_small": "model.backbones.huggingface:DINOv3",
    "vit_small_fsra": "model.backbones.vit:FSRAViT",
    "dinov2_small_qdfl": "model.backbones.dinov2_adapters:DINOv2Adapters",
    "dinov2_base_qdfl": "model.backbones.dinov2_adapters:DINOv2Adapters",
    "convnext_tiny": "model.backbones.huggingface:ConvNeXt",
    "convnext_base": "model.backbones.huggingface:ConvNeXt",
    "swin_tiny": "model.backbones.huggingface:Swin",
}
"""Module and class by the backbone's name. A name and not the class: command lines list the
backbones without loading torch."""
HUB_PREFIX = "hf:"
"Before OWNER/NAME of weights on the Hugging Face hub, where a path could stand."
