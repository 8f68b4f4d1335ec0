"""What a training starts from: random weights, ImageNet's, the built-in encoder's, or a file's.

In: an encoder with random weights. Out: the same encoder with those weights.
"""

from model.backbones import HUB_PREFIX
from model.checkpoint import build_encoder, is_checkpoint, loads
from model.config import Start
from model.errors import CheckpointError
from model.pvda import FeatureEncoder
from model.weights.builtin import read_builtin
from model.weights.load import load_backbone, parse_state_dict, read_weights_file
from model.weights.packaged import imagenet_weights
from model.weights.pretrained import comes_as_folder


def load_start(encoder: FeatureEncoder, backbone: str, start: Start, file: str | None) -> None:
    """Load the weights of `file` where one is given, else those that `start` names.

    A file is a checkpoint of ours, of which rings and refinement are taken too, or public weights
    of the backbone; so are a folder and a name on the hub, for backbones whose weights come so.
    Raises CheckpointError.
    """
    if file is not None and comes_as_folder(file):
        if not encoder.backbone.loads_folders:
            raise CheckpointError(
                f"{file} is a folder or a name on the hub, expected one file for {backbone}; name "
                "the file in it, or choose the --backbone that it was made for"
            )
        encoder.backbone.load_pretrained(file)
    elif file is not None:
        data = read_weights_file(file)
        if is_checkpoint(data):
            _load_encoder(encoder, data, file)
        elif encoder.backbone.loads_folders:
            raise CheckpointError(
                f"{file} is one file, expected a folder with config.json and model.safetensors for "
                f"{backbone}; name the folder, or a name on the hub as {HUB_PREFIX}OWNER/NAME"
            )
        else:
            load_backbone(encoder.backbone, parse_state_dict(data, file), file)
    elif start == "imagenet" and encoder.backbone.loads_folders:
        raise CheckpointError(
            f"no package holds public weights of {backbone}, expected --weights; give a folder of "
            f"save_pretrained, or a name on the hub as {HUB_PREFIX}OWNER/NAME"
        )
    elif start == "imagenet":
        load_backbone(encoder.backbone, imagenet_weights(backbone), "ImageNet's weights")
    elif start == "builtin":
        _load_encoder(encoder, read_builtin(), "the built-in encoder")


def _load_encoder(encoder: FeatureEncoder, data: bytes, name: str) -> None:
    """Weights of another encoder of the same sizes; images may have another size."""
    given, own = build_encoder(loads(data, name)).state_dict(), encoder.state_dict()
    differing = [
        f"{key} is {tuple(given[key].shape) if key in given else 'missing'}"
        for key in own
        if key not in given or given[key].shape != own[key].shape
    ]
    if differing or given.keys() != own.keys():
        first = (
            differing[0] if differing else f"{next(iter(given.keys() - own.keys()))} is too many"
        )
        raise CheckpointError(
            f"{name} is of another network ({first}), expected this recipe's; set --backbone, "
            "--width, --parts and --part-dim as it was trained"
        )
    encoder.load_state_dict(given)
