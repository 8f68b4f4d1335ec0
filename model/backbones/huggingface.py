"""Vision transformers and their kin, as the library `transformers` builds them.

In: normalised images (B, 3, H, W), sides a multiple of the stride. Out: feature maps (B, C,
H/stride, W/stride): patch tokens as cells, without class and register tokens. The library is an
optional extra and is imported when a network is built. Another network of it is a class with its
sizes here, and one line in `BACKBONES`.
"""

from importlib import import_module
from typing import Any, ClassVar, Self

from torch import Tensor, nn

from model.backbones import HUB_PREFIX
from model.backbones.base import Backbone, Features
from model.errors import MissingLibrary
from model.weights.pretrained import read_pretrained

IMAGENET = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"Mean and standard deviation that most public weights were trained with."


class HuggingFaceBackbone(Backbone):
    """A network of `transformers` with its own state-dict names, below `network.`."""

    foreign_names: ClassVar[dict[str, str]] = {}  # the library itself renames older weights
    foreign_extra = ()
    loads_folders = True
    quantizable = False  # neither its export nor its agreement has been measured
    model_class: ClassVar[str]
    "Name of the network's class in `transformers`; its settings are the class's `config_class`."
    model_options: ClassVar[dict[str, Any]] = {}
    "Arguments of that class beside its settings."
    call_options: ClassVar[dict[str, Any]] = {}
    "Arguments of its forward beside the images."
    sizes: ClassVar[dict[str, dict[str, Any]]]
    "Settings by our name of the network; all others are the library's defaults."
    hub_names: ClassVar[dict[str, str]]
    "Public weights on the hub by our name of the network."
    parts: ClassVar[tuple[tuple[str, ...], str, tuple[str, ...]]]
    "Submodules before the blocks, the list of blocks, and after it."
    unused: ClassVar[tuple[str, ...]] = ()
    """Parameters that the maps do not depend on. They stay in the state dict, so that its names are
    the published ones, and have no gradient: DistributedDataParallel waits for each that has."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name
        kind = getattr(import_transformers(), self.model_class)
        config = kind.config_class(**self.sizes[name])
        self.network: nn.Module = kind(config, **self.model_options)
        self.channels = int((getattr(config, "hidden_sizes", None) or [config.hidden_size])[-1])
        for unused in self.unused:
            self.network.get_parameter(unused).requires_grad_(False)

    @classmethod
    def build(cls, name: str, width: float) -> Self:
        """The network of that name. Raises ValueError for a width other than 1, and
        MissingLibrary.
        """
        if width != 1:
            raise ValueError(
                f"width is {width}, expected 1 for {name}, which has the channels of its public "
                "weights; set --width 1, or choose a ResNet or EfficientNet-Lite"
            )
        return cls(name)

    @classmethod
    def infer(cls, state: dict[str, Tensor]) -> tuple[str, float]:
        """Always raises ValueError: the size is told by config.json and not by the tensors."""
        raise ValueError("networks of transformers come as a folder (train.py --weights FOLDER)")

    def stages(self) -> list[list[nn.Module]]:
        """The embedding of patches, each block (of ConvNeXt and Swin: each stage), the last norm.

        ConvNeXt's maps have no norm.
        """
        first, blocks, last = self.parts
        listed = self.network.get_submodule(blocks).children()
        ends = [[self.network.get_submodule(name)] for name in last]
        return [[self.network.get_submodule(name) for name in first], *([b] for b in listed), *ends]

    def check_size(self, height: int, width: int) -> None:
        """Raises ValueError where a side is no multiple of the stride."""
        for side in (height, width):
            if side % self.stride or side < self.stride:
                lower = max(side // self.stride, 1) * self.stride
                raise ValueError(
                    f"images have {side} pixels a side, expected a multiple of {self.stride} for "
                    f"{self.name}; set --image-size {lower} or {lower + self.stride}"
                )

    def forward(self, images_B3HW: Tensor) -> Tensor:
        """Normalised images (B, 3, H, W) -> maps (B, C, H/stride, W/stride).

        No gradient reaches frozen stages: nothing before them or in them asks for one. Raises
        ValueError as `check_size` does.
        """
        return self.features(images_B3HW).maps_BCHW

    def features(self, images_B3HW: Tensor) -> Features:
        """Maps as `forward`'s, and the class token of networks that have one."""
        height, width = images_B3HW.shape[2:]
        self.check_size(height, width)
        found: Tensor = self.network(images_B3HW, **self.call_options).last_hidden_state
        if found.dim() == 4:
            return Features(found, None)
        rows, columns = height // self.stride, width // self.stride
        patches_BNC = found[:, found.shape[1] - rows * columns :]  # after class and registers
        cells_BHWC = patches_BNC.reshape(patches_BNC.shape[0], rows, columns, self.channels)
        token_BC = found[:, 0] if self.has_token else None
        return Features(cells_BHWC.permute(0, 3, 1, 2), token_BC)

    def load_pretrained(self, source: str) -> None:
        """Load a folder of `save_pretrained`, or `hf:OWNER/NAME` from the hub.

        Raises CheckpointError.
        """
        example = f"{HUB_PREFIX}{self.hub_names[self.name]}"
        self.network.load_state_dict(
            read_pretrained(
                self.network, source, tuple(self.sizes[self.name]), self.model_options, example
            )
        )


class ViT(HuggingFaceBackbone):
    """Vision Transformer with patches of 16 pixels (Dosovitskiy, arXiv 2010.11929)."""

    stride = 16
    has_token = True
    mean, std = (0.5, 0.5, 0.5), (0.5, 0.5, 0.5)  # as its public weights were trained
    model_class = "ViTModel"
    model_options: ClassVar[dict[str, Any]] = {"add_pooling_layer": False}
    call_options: ClassVar[dict[str, Any]] = {"interpolate_pos_encoding": True}
    sizes: ClassVar[dict[str, dict[str, Any]]] = {
        "vit_small": {
            "hidden_size": 384, "num_hidden_layers": 12, "num_attention_heads": 6,
            "intermediate_size": 1536, "patch_size": 16, "image_size": 224,
        },
        "vit_base": {
            "hidden_size": 768, "num_hidden_layers": 12, "num_attention_heads": 12,
            "intermediate_size": 3072, "patch_size": 16, "image_size": 224,
        },
    }  # fmt: skip
    hub_names: ClassVar[dict[str, str]] = {
        "vit_small": "WinKawaks/vit-small-patch16-224",
        "vit_base": "google/vit-base-patch16-224-in21k",
    }
    parts = (("embeddings",), "layers", ("layernorm",))


class DINOv2(HuggingFaceBackbone):
    """ViT with patches of 14 pixels, trained without labels (Oquab, arXiv 2304.07193)."""

    stride = 14
    has_token = True
    mean, std = IMAGENET
    model_class = "Dinov2Model"
    sizes: ClassVar[dict[str, dict[str, Any]]] = {
        "dinov2_small": {
            "hidden_size": 384, "num_hidden_layers": 12, "num_attention_heads": 6,
            "patch_size": 14, "image_size": 518,
        },
        "dinov2_base": {
            "hidden_size": 768, "num_hidden_layers": 12, "num_attention_heads": 12,
            "patch_size": 14, "image_size": 518,
        },
    }  # fmt: skip
    hub_names: ClassVar[dict[str, str]] = {
        "dinov2_small": "facebook/dinov2-small",
        "dinov2_base": "facebook/dinov2-base",
    }
    parts = (("embeddings",), "encoder.layer", ("layernorm",))
    unused = ("embeddings.mask_token",)


class DINOv3(HuggingFaceBackbone):
    """ViT with rotary positions and four register tokens (Simeoni, arXiv 2508.10104).

    In training its positions are scaled at random, as published; not where its embedding is frozen.
    """

    stride = 16
    has_token = True
    mean, std = IMAGENET
    model_class = "DINOv3ViTModel"
    sizes: ClassVar[dict[str, dict[str, Any]]] = {
        "dinov3_small": {
            "hidden_size": 384, "num_hidden_layers": 12, "num_attention_heads": 6,
            "intermediate_size": 1536, "patch_size": 16, "num_register_tokens": 4,
        },
    }  # fmt: skip
    hub_names: ClassVar[dict[str, str]] = {
        "dinov3_small": "facebook/dinov3-vits16-pretrain-lvd1689m"
    }
    parts = (("embeddings", "rope_embeddings"), "model.layer", ("norm",))
    unused = ("embeddings.mask_token",)


class ConvNeXt(HuggingFaceBackbone):
    """ConvNeXt (Liu, arXiv 2201.03545); its last norm follows a pooling that the maps lack."""

    stride = 32
    mean, std = IMAGENET
    model_class = "ConvNextModel"
    sizes: ClassVar[dict[str, dict[str, Any]]] = {
        "convnext_tiny": {
            "hidden_sizes": [96, 192, 384, 768], "depths": [3, 3, 9, 3], "patch_size": 4,
        },
        "convnext_base": {
            "hidden_sizes": [128, 256, 512, 1024], "depths": [3, 3, 27, 3], "patch_size": 4,
        },
    }  # fmt: skip
    hub_names: ClassVar[dict[str, str]] = {
        "convnext_tiny": "facebook/convnext-tiny-224",
        "convnext_base": "facebook/convnext-base-384-22k-1k",
    }
    parts = (("embeddings",), "encoder.stages", ())
    unused = ("layernorm.weight", "layernorm.bias")


class Swin(HuggingFaceBackbone):
    """Swin Transformer (Liu, arXiv 2103.14030) with stochastic depth 0.1, as published."""

    stride = 32
    mean, std = IMAGENET
    model_class = "SwinModel"
    model_options: ClassVar[dict[str, Any]] = {"add_pooling_layer": False}
    sizes: ClassVar[dict[str, dict[str, Any]]] = {
        "swin_tiny": {
            "embed_dim": 96, "depths": [2, 2, 6, 2], "num_heads": [3, 6, 12, 24],
            "window_size": 7, "patch_size": 4,
        },
    }  # fmt: skip
    hub_names: ClassVar[dict[str, str]] = {"swin_tiny": "microsoft/swin-tiny-patch4-window7-224"}
    parts = (("embeddings",), "encoder.layers", ("layernorm",))

    def check_size(self, height: int, width: int) -> None:
        """Raises ValueError also where the last stage has fewer cells than a window: the library's
        position bias has the window's size."""
        super().check_size(height, width)
        config: Any = self.network.config
        least = config.window_size * self.stride
        if min(height, width) < least:
            raise ValueError(
                f"images have {min(height, width)} pixels a side, expected at least {least} for "
                f"{self.name}; set --image-size {least} or more"
            )


def import_transformers() -> Any:
    """The library. Raises MissingLibrary with the command that installs it."""
    try:
        library = import_module("transformers")
        import_module("transformers.modeling_utils")  # `transformers` itself imports on use
    except ImportError as error:
        raise MissingLibrary(
            f"this backbone needs transformers, which cannot be imported here ({error}); pip "
            "install 'pvda[transformers]', or choose another --backbone"
        ) from error
    return library
