"""MCCG's weights -> ours: the state dict of a `two_view_net` of the public MCCG code
(github.com/mode-str/crossview: models/model.py, models/ConvNext).

Its one network for both views stands below `model_1.`: a ConvNeXt-T by Facebook's names, the two
gates and three classifiers, which hold our refinement (`add_block`) and our location classifier. An
image's parts are the gated ones and then the whole, as its test has them.
"""

from torch import Tensor

from model.config import PVDAConfig
from model.errors import CheckpointError
from model.two_views import EncoderWithClassifier
from model.weights.load import load_renamed
from model.weights.lpn import ConvertedWeights, classifier_names, linear_outputs

SHARED, STREET = "model_1.", "model_2."
MCCG_CLASSIFIERS = ("classifier_mcb1", "classifier_mcb2", "classifier1")
"Of our parts, in order."
NETWORK = r"encoder\.backbone\.network\."
NETWORK_LAYERS = NETWORK + r"encoder\.stages\.(\d)\.layers\.(\d+)\."
OURS_TO_MCCG = {
    NETWORK + r"embeddings\.patch_embeddings\.": "convnext.downsample_layers.0.0.",
    NETWORK + r"embeddings\.layernorm\.": "convnext.downsample_layers.0.1.",
    NETWORK + r"encoder\.stages\.(\d)\.downsampling_layer\.": r"convnext.downsample_layers.\1.",
    NETWORK_LAYERS + r"layernorm\.": r"convnext.stages.\1.\2.norm.",
    NETWORK_LAYERS + "layer_scale_parameter": r"convnext.stages.\1.\2.gamma",
    NETWORK_LAYERS: r"convnext.stages.\1.\2.",  # dwconv, pwconv1, pwconv2
    r"encoder\.pooling\.norm\.": "convnext.norm.",
    r"encoder\.pooling\.over_width\.conv\.": "tri_layer.cw.conv.conv.",
    r"encoder\.pooling\.over_width\.norm\.": "tri_layer.cw.conv.bn.",
    r"encoder\.pooling\.over_height\.conv\.": "tri_layer.hc.conv.conv.",
    r"encoder\.pooling\.over_height\.norm\.": "tri_layer.hc.conv.bn.",
}
"Beginnings of an EncoderWithClassifier's names -> MCCG's below `model_1.`, but the classifiers'."
UNUSED_NORM = ("encoder.backbone.network.layernorm.",)
"In our backbone, and without effect: the norm of the whole is the pooling's."


def convert_mccg(state: dict[str, Tensor], name: str, image_size: int = 256) -> ConvertedWeights:
    """Encoder and classifier that embed and classify as MCCG's do.

    `image_size`, in pixels, is the training's, 256 in the public code. Raises CheckpointError that
    lists what is missing or unexpected.
    """
    given = {
        key.removeprefix(SHARED): tensor
        for key, tensor in state.items()
        if not key.startswith((f"{SHARED}convnext.head.", STREET))
    }
    first = f"{MCCG_CLASSIFIERS[0]}.add_block.0.weight"
    if first not in given or "convnext.downsample_layers.0.0.weight" not in given:
        raise CheckpointError(
            f"{name} is no two_view_net of MCCG: its names begin with "
            f"{', '.join(list(state)[:3]) or 'nothing'}; expected {SHARED}convnext.* of a "
            f"ConvNeXt-T and {SHARED}{first}; give the net_*.pth of a training run without --resnet"
        )
    network = PVDAConfig(
        backbone="convnext_tiny", image_size=image_size, pooling="cross_gates",
        parts=len(MCCG_CLASSIFIERS), neck="linear_ones", part_dim=len(given[first]), dropout=0.5,
    )  # fmt: skip
    locations = linear_outputs(given, f"{MCCG_CLASSIFIERS[0]}.classifier.0.weight", name)
    model = EncoderWithClassifier(network, locations)
    load_renamed(
        model, given, f"{name} is no two_view_net of MCCG",
        "give the net_*.pth of a training run of MCCG with --block 2",
        OURS_TO_MCCG | classifier_names(MCCG_CLASSIFIERS), UNUSED_NORM,
    )  # fmt: skip
    street = any(key.startswith(STREET) for key in state)
    return ConvertedWeights.of(network, model, locations, STREET.strip(".") if street else None)
