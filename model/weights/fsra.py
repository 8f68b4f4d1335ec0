"""FSRA's weights -> ours: the state dict of a `two_view_net` of the public FSRA code
(github.com/Dmmm1997/FSRA).

Its transformer and classifiers stand below one prefix or two, which are found by the names that end
them [inferred: only those are known to us]. An image's parts are the heat regions and then the
class token, as its test has them.
"""

import re

from torch import Tensor

from model.config import PVDAConfig
from model.errors import CheckpointError
from model.two_views import EncoderWithClassifier
from model.weights.load import load_renamed
from model.weights.lpn import ConvertedWeights, classifier_names, linear_outputs

TOKEN = "classifier1"
PATCHES, FIRST_LINEAR = "patch_embed.proj.weight", f"{TOKEN}.add_block.0.weight"


def convert_fsra(state: dict[str, Tensor], name: str, image_size: int = 256) -> ConvertedWeights:
    """Encoder and classifier that embed and classify as FSRA's do.

    `image_size`, in pixels, is the training's, 256 in the public code. Raises CheckpointError that
    lists what is missing or unexpected.
    """
    trunk, heads = (_prefix(state, end, name) for end in (PATCHES, FIRST_LINEAR))
    given = {
        key.removeprefix(trunk): tensor
        for key, tensor in state.items()
        if key.startswith(trunk)
        and not key.startswith((f"{trunk}fc.", f"{trunk}head."))
        and not re.match(rf"{re.escape(heads)}classifier\w+\.", key)
    }
    given |= {
        key.removeprefix(heads): tensor
        for key, tensor in state.items()
        if re.match(rf"{re.escape(heads)}classifier\w+\.", key)
    }
    regions = len({key.split(".")[0] for key in given if key.startswith("classifier_heat")})
    names = [*(f"classifier_heat{region + 1}" for region in range(regions)), TOKEN]
    network = PVDAConfig(
        backbone="vit_small_fsra", image_size=image_size, pooling="heat_regions", parts=len(names),
        neck="linear_ones", part_dim=linear_outputs(given, FIRST_LINEAR, name), dropout=0.5,
    )  # fmt: skip
    locations = linear_outputs(given, f"{TOKEN}.classifier.0.weight", name)
    model = EncoderWithClassifier(network, locations)
    table = {
        r"encoder\.backbone\.embed\.proj\.": "patch_embed.proj.",
        r"encoder\.backbone\.embed\.": "",
        r"encoder\.backbone\.": "",
    }
    load_renamed(
        model, model.encoder.backbone.adapt(given), f"{name} is no two_view_net of FSRA",
        "give the net_*.pth of a training run of FSRA", table | classifier_names(tuple(names)),
    )  # fmt: skip
    return ConvertedWeights.of(network, model, locations)


def _prefix(state: dict[str, Tensor], end: str, name: str) -> str:
    """What stands before the one name that ends so. Raises CheckpointError where there is none."""
    found = [key for key in state if key == end or key.endswith("." + end)]
    if not found:
        raise CheckpointError(
            f"{name} is no two_view_net of FSRA: no name ends with {end}, and they begin with "
            f"{', '.join(list(state)[:3]) or 'nothing'}; expected the net_*.pth of a training run"
        )
    return found[0].removesuffix(end)
