"""QDFL's weights -> ours: the checkpoint of a `U1652_model` of the public QDFL code
(github.com/Shuyu-Hu/QDFL: plModules/U1652_baseline.py, model/components/QDFL.py).

DINOv2 with its adapters stands below `backbone.model.`, the head below `components.`. An image's
parts are the two queries, the class token and the generalised mean, as its test has them. Its test
loop adds the mirror image's vector to the image's own after that one alone was brought to length 1,
which leaves almost the mirror image's; ours adds the two as they are.
"""

from torch import Tensor

from model.backbones.dinov2_adapters import DINOv2Adapters, unchunked
from model.config import PVDAConfig
from model.errors import CheckpointError
from model.two_views import EncoderWithClassifier
from model.weights.load import load_renamed
from model.weights.lpn import ConvertedWeights, classifier_names, linear_outputs

TRUNK, HEAD = "backbone.model.", "components."
QDFL_CLASSIFIERS = tuple(
    f"{HEAD}{name}"
    for name in ("classifier0", "classifier1", "token_classifier", "gem_feature_classifier")
)
"Of our parts, in order."
ATTENTION, NORM = r"encoder\.pooling\.attention\.", r"encoder\.pooling\.norm\."
OURS_TO_QDFL = {
    r"encoder\.backbone\.embed\.proj\.": f"{TRUNK}patch_embed.proj.",
    r"encoder\.backbone\.embed\.": TRUNK,
    r"encoder\.backbone\.": TRUNK,
    r"encoder\.pooling\.reduce\.": f"{HEAD}AQEU.fc.",
    r"encoder\.pooling\.queries": f"{HEAD}AQEU.coarse.queries",
    ATTENTION + r"cells\.": f"{HEAD}AQEU.coarse.self_attn0.",
    ATTENTION + r"queries_self\.": f"{HEAD}AQEU.coarse.self_attn.",
    ATTENTION + r"queries_cells\.": f"{HEAD}AQEU.coarse.cross_attn.",
    ATTENTION + r"queries_fused\.": f"{HEAD}AQEU.cross_attn.",
    NORM + r"cells\.": f"{HEAD}AQEU.coarse.norm_x.",
    NORM + r"queries_self\.": f"{HEAD}AQEU.coarse.norm_q.",
    NORM + r"queries_cells\.": f"{HEAD}AQEU.coarse.norm_out.",
    NORM + r"before_fused\.": f"{HEAD}AQEU.norm_q.",
    NORM + r"queries_fused\.": f"{HEAD}AQEU.norm_out.",
    r"encoder\.pooling\.fusion\.horizontal\.conv\.": f"{HEAD}AQEU.FFU.cycle1.",
    r"encoder\.pooling\.fusion\.vertical\.conv\.": f"{HEAD}AQEU.FFU.cycle2.",
    r"encoder\.pooling\.fusion\.gate\.0\.": f"{HEAD}AQEU.FFU.reweight.fc1.",
    r"encoder\.pooling\.fusion\.gate\.2\.": f"{HEAD}AQEU.FFU.reweight.fc2.",
    r"encoder\.pooling\.combine\.": f"{HEAD}AQEU.query_remap.",
    r"encoder\.pooling\.power": f"{HEAD}gem_fusion.p",
} | classifier_names(QDFL_CLASSIFIERS)
"Beginnings of an EncoderWithClassifier's names -> QDFL's."
MASK_TOKEN = (f"{TRUNK}mask_token",)
"Unused, and not in every file."


def convert_qdfl(state: dict[str, Tensor], name: str, image_size: int = 280) -> ConvertedWeights:
    """Encoder and classifier that embed and classify as QDFL's do.

    `image_size`, in pixels, is the one to embed at: QDFL trains at 224 and tests at 280. Raises
    CheckpointError that lists what is missing or unexpected.
    """
    trunk = unchunked(
        {key.removeprefix(TRUNK): one for key, one in state.items() if key.startswith(TRUNK)}
    )
    adapted = "blocks.0.adapter1.D_fc1.weight" in trunk
    if not adapted or f"{HEAD}AQEU.fc.weight" not in state:
        raise CheckpointError(
            f"{name} is no U1652_model of QDFL: its names begin with "
            f"{', '.join(list(state)[:3]) or 'nothing'}; expected DINOv2 with adapters below "
            f"{TRUNK} and {HEAD}AQEU.*; give the checkpoint of a run of dino_b_QDFL.yaml or "
            "dino_s_QDFL.yaml"
        )
    try:
        backbone, _ = DINOv2Adapters.infer(trunk)
    except ValueError as error:
        raise CheckpointError(f"{name}: {error}, expected ViT-S or ViT-B") from error
    given = {f"{TRUNK}{key}": tensor for key, tensor in trunk.items()} | {
        key: tensor
        for key, tensor in state.items()
        # The offsets of its shifted channels are constants.
        if not key.startswith(TRUNK) and not key.endswith(".offset")
    }
    first = QDFL_CLASSIFIERS[0]
    network = PVDAConfig(
        backbone=backbone, image_size=image_size, pooling="queries", parts=len(QDFL_CLASSIFIERS),
        part_dim=linear_outputs(given, f"{first}.add_block.0.weight", name), dropout=0.5,
    )  # fmt: skip
    locations = linear_outputs(given, f"{first}.classifier.0.weight", name)
    model = EncoderWithClassifier(network, locations)
    load_renamed(
        model, given, f"{name} is no U1652_model of QDFL",
        "give the checkpoint of a run of dino_b_QDFL.yaml or dino_s_QDFL.yaml",
        OURS_TO_QDFL, MASK_TOKEN,
    )  # fmt: skip
    return ConvertedWeights.of(network, model, locations)
