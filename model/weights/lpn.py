"""LPN's weights -> ours: the state dict of a `three_view_net` of the public LPN code
(github.com/wtyhub/LPN, model.py).

LPN keeps a backbone per view: `model_1` sees satellite images, `model_2` street and web images,
`model_3` the UAV's. With its option --share the third is the first. Its classifiers hold our
refinement (`add_block`) and our location classifier. Shapes: P rings, C channels of the maps, D
numbers per ring, L locations.
"""

import re
from dataclasses import dataclass

import torch
from torch import Tensor

from model.config import PVDAConfig
from model.errors import CheckpointError
from model.two_views import EncoderWithClassifier
from model.weights.load import infer_backbone, load_renamed

OURS_TO_LPN = {
    r"encoder\.backbone\.": "model_1.model.",
    # Linear and BatchNorm. LPN's add_block.2 is dropout and holds nothing. Its rings stand centre
    # first, as ours do.
    r"encoder\.refine\.(\d+)\.([01])\.": r"classifier\1.add_block.\2.",
    r"classifier\.branches\.(\d+)\.": r"classifier\1.classifier.0.",
}
"Beginnings of an EncoderWithClassifier's names -> LPN's."


@dataclass(frozen=True, kw_only=True)
class ConvertedWeights:
    """A public network as one of ours."""

    network: PVDAConfig
    modules: dict[str, dict[str, Tensor]]
    "State dicts of encoder and classifier, as in a checkpoint."
    locations: int
    """L, the classifier's outputs. Their names are not in the file: they are the training folders',
    sorted."""
    left_out: str | None
    "The network of a view that PVDA does not have, where it differs from the converted one."

    @classmethod
    def of(
        cls,
        network: PVDAConfig,
        model: EncoderWithClassifier,
        locations: int,
        left_out: str | None = None,
    ) -> "ConvertedWeights":
        """An encoder with its classifier, once the public weights are loaded."""
        modules = {
            "encoder": model.encoder.state_dict(),
            "classifier": model.classifier.state_dict(),
        }
        return cls(network=network, modules=modules, locations=locations, left_out=left_out)


def convert_lpn(state: dict[str, Tensor], name: str, image_size: int = 256) -> ConvertedWeights:
    """Encoder and classifier that embed and classify as LPN's do, its rings averaged over their
    boxes.

    `image_size`, in pixels, is not in the file but in LPN's opts.yaml, and so are its stride and
    its pooling: 1 and avg are assumed, as in LPN's run on University-1652.

    Raises CheckpointError that lists what is missing or unexpected, or where UAV and satellite
    images have backbones of their own; ValueError where the image size is none that PVDAConfig
    allows.
    """
    numbers = sorted(
        {int(found[1]) for key in state if (found := re.match(r"classifier(\d+)\.", key))}
    )
    if not numbers or numbers != list(range(len(numbers))):
        raise CheckpointError(
            f"{name} is no three_view_net of LPN: its classifiers are numbered "
            f"{numbers or 'not at all'} and its names begin "
            f"with {', '.join(list(state)[:3]) or 'nothing'}; expected classifier0, classifier1, "
            "... and model_1.model.*"
        )
    backbone, width = infer_backbone(backbone_of(state, "model_1"), f"{name} (model_1.model)")
    left_out = check_shared_backbone(state, name)
    network = PVDAConfig(
        backbone=backbone, width=width, image_size=image_size, parts=len(numbers),
        part_dim=linear_outputs(state, "classifier0.add_block.0.weight", name), ring_divisor="box",
    )  # fmt: skip
    model = EncoderWithClassifier(
        network, locations := linear_outputs(state, "classifier0.classifier.0.weight", name)
    )
    given = {
        key: tensor
        for key, tensor in state.items()
        if not re.match(r"model_[23]\.model\.|model_1\.model\.fc\.", key)
    }
    load_renamed(
        model, given, f"{name} does not fit {backbone} with {len(numbers)} rings",
        "expected a three_view_net of LPN with average pooling", OURS_TO_LPN,
    )  # fmt: skip
    return ConvertedWeights.of(network, model, locations, left_out)


def backbone_of(state: dict[str, Tensor], view: str) -> dict[str, Tensor]:
    """One view's backbone by torchvision's names, without its ImageNet classifier."""
    start = f"{view}.model."
    backbone = {
        key.removeprefix(start): tensor for key, tensor in state.items() if key.startswith(start)
    }
    return {key: tensor for key, tensor in backbone.items() if not key.startswith("fc.")}


def check_shared_backbone(state: dict[str, Tensor], name: str) -> str | None:
    """The backbone that is left out: the street view's, where it has its own.

    The UAV's must be the satellite's (in a file of two views, the second the first): PVDA's encoder
    is shared by both. Raises CheckpointError where it is not.
    """
    other = "model_3" if backbone_of(state, "model_3") else "model_2"
    if differing := differing_tensors(state, other):
        raise CheckpointError(
            f"{name} has a backbone per view: model_1 and {other} differ in {len(differing)} "
            f"tensors, {differing[0]} first; "
            "expected one for satellite and UAV images; train LPN with --share"
        )
    return "model_2" if differing_tensors(state, "model_2") else None


def differing_tensors(state: dict[str, Tensor], other: str) -> list[str]:
    """Names of the tensors that differ between the backbones of model_1 and another view; none
    where the file has no other.
    """
    first, second = backbone_of(state, "model_1"), backbone_of(state, other)
    names = [*first, *(key for key in second if key not in first)] if second else []
    return [
        key
        for key in names
        if not (key in first and key in second and tensors_equal(first[key], second[key]))
    ]


def tensors_equal(one: Tensor, other: Tensor) -> bool:
    return one.shape == other.shape and one.dtype == other.dtype and torch.equal(one, other)


def linear_outputs(state: dict[str, Tensor], key: str, name: str) -> int:
    """Outputs of the Linear whose weight is `key`. Raises CheckpointError where it is no Linear."""
    if key not in state or state[key].ndim != 2:
        found = f"of shape {tuple(state[key].shape)}" if key in state else "missing"
        raise CheckpointError(
            f"{name} is no three_view_net of LPN: {key} is {found}, expected a Linear's weight"
        )
    return len(state[key])


def classifier_names(classifiers: tuple[str, ...]) -> dict[str, str]:
    """Beginnings of our parts' names -> those of the lineage's classifier blocks, by part."""
    names = {}
    for part, classifier in enumerate(classifiers):
        names[rf"encoder\.refine\.{part}\."] = f"{classifier}.add_block."
        names[rf"classifier\.branches\.{part}\."] = f"{classifier}.classifier.0."
    return names
