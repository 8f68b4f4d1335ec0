"""Sample4Geo's weights -> ours: the state dict of its `TimmModel`, a ConvNeXt of timm below
`model.` (github.com/Skyy93/Sample4Geo).

Its one part is the mean of the maps after the head's LayerNorm; the learnt temperature is of its
training only and is left out.
"""

from torch import Tensor

from model.config import PVDAConfig
from model.errors import CheckpointError
from model.pvda import FeatureEncoder
from model.weights.load import load_renamed
from model.weights.lpn import ConvertedWeights

PREFIX, TEMPERATURE = "model.", "logit_scale"
LAYERS = r"backbone\.network\.encoder\.stages\.(\d)\.layers\.(\d+)\."
OURS_TO_TIMM = {
    r"backbone\.network\.embeddings\.patch_embeddings\.": "stem.0.",
    r"backbone\.network\.embeddings\.layernorm\.": "stem.1.",
    r"backbone\.network\.encoder\.stages\.(\d)\.downsampling_layer\.": r"stages.\1.downsample.",
    LAYERS + r"dwconv\.": r"stages.\1.blocks.\2.conv_dw.",
    LAYERS + r"layernorm\.": r"stages.\1.blocks.\2.norm.",
    LAYERS + r"pwconv(\d)\.": r"stages.\1.blocks.\2.mlp.fc\3.",
    LAYERS + "layer_scale_parameter": r"stages.\1.blocks.\2.gamma",
    r"refine\.0\.": "head.norm.",
}
"Beginnings of our encoder's names -> timm's."
SIZES = {(9, 96): "convnext_tiny", (27, 128): "convnext_base"}
"Blocks of the third stage and channels of the first -> the backbone."
UNUSED = ("backbone.network.layernorm.",)
"In our backbone, and without effect: the neck is that norm."


def convert_sample4geo(
    state: dict[str, Tensor], name: str, image_size: int = 384
) -> ConvertedWeights:
    """The encoder that embeds as Sample4Geo's does, without mirror images.

    `image_size`, in pixels, is the training's, 384 in the public code. Raises CheckpointError that
    lists what is missing or unexpected.
    """
    given = {
        key.removeprefix(PREFIX): tensor
        for key, tensor in state.items()
        if key != TEMPERATURE and not key.startswith((f"{PREFIX}head.fc.", "head.fc."))
    }
    blocks = len({key for key in given if key.startswith("stages.2.") and key.endswith(".gamma")})
    stem = given.get("stem.0.weight")
    backbone = SIZES.get((blocks, 0 if stem is None else len(stem)))
    if backbone is None:
        raise CheckpointError(
            f"{name} is no TimmModel of Sample4Geo: {blocks} blocks in stages.2, and the names "
            f"begin with {', '.join(list(state)[:3]) or 'nothing'}; expected timm's ConvNeXt-T or "
            f"-B below {PREFIX}"
        )
    squeezed = {
        key: tensor.flatten(1) if ".mlp." in key and tensor.dim() == 4 else tensor
        for key, tensor in given.items()
    }
    network = PVDAConfig(
        backbone=backbone, image_size=image_size, pooling="mean", parts=1, neck="norm",
        part_dim=len(squeezed.get("head.norm.weight", ())) or 1, dropout=0.0,
    )  # fmt: skip
    try:
        encoder = FeatureEncoder(network)
    except ValueError as error:  # a head.norm of other channels
        raise CheckpointError(f"{name} is no TimmModel of Sample4Geo: {error}") from error
    load_renamed(
        encoder, squeezed, f"{name} is no TimmModel of Sample4Geo",
        "give the weights_*.pth of a training run of Sample4Geo", OURS_TO_TIMM, UNUSED,
    )  # fmt: skip
    return ConvertedWeights(
        network=network, modules={"encoder": encoder.state_dict()}, locations=0, left_out=None
    )
