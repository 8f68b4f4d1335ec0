"""Networks of the compared methods have the published numbers of parameters, to the digit."""

import pytest
import torch

from jobs.training.recipes import RECIPES
from model.losses.objective import Objective
from model.pvda import FeatureEncoder, LocationClassifier
from model.two_views import EncoderWithClassifier

pytestmark = pytest.mark.slow

LOCATIONS = 701
PUBLISHED = {
    "instance_loss": 24_917_757,
    "lpn": 29_146_932,
    "usam": 24_917_757 + 4,
    "usam_lpn": 29_146_932 + 4,
    "fsra": 51_048_948,
    "mccg": 30_083_423,
    "qdfl": 22_288_305,
}
"Encoder and location classifier of 701 places; of QDFL what is trained."


@pytest.mark.parametrize("name", PUBLISHED)
def test_method_has_the_published_parameters(name: str) -> None:
    with torch.device("meta"):
        model = EncoderWithClassifier(RECIPES[name]().network, LOCATIONS)
    trained = sum(p.numel() for p in model.parameters() if p.requires_grad)
    assert trained == PUBLISHED[name]


def test_qdfl_freezes_its_trunk() -> None:
    with torch.device("meta"):
        model = EncoderWithClassifier(RECIPES["qdfl"]().network, LOCATIONS)
    assert sum(p.numel() for p in model.parameters()) == 108_868_785
    trunk = [name for name, _ in model.encoder.backbone.named_parameters() if "adapter" not in name]
    frozen = [name for name, p in model.encoder.backbone.named_parameters() if not p.requires_grad]
    assert frozen == trunk


@pytest.mark.parametrize("name", ["sample4geo", "dac", "camp"])
def test_contrastive_encoder_is_convnext_base_alone(name: str) -> None:
    network = RECIPES[name]().network
    with torch.device("meta"):
        encoder = FeatureEncoder(network)
    assert sum(p.numel() for p in encoder.parameters() if p.requires_grad) == 87_566_464
    assert network.embedding_dim == 1024


def test_dac_and_camp_learn_the_published_extras() -> None:
    counts = {}
    for name in ("sample4geo", "dac", "camp"):
        recipe = RECIPES[name]()
        with torch.device("meta"):
            objective = Objective(recipe.losses, recipe.network, 1024, 32, LOCATIONS)
        counts[name] = sum(p.numel() for p in objective.parameters())
    heads = 3 * (525_824 + 359_613)  # MCCG's on 1,024 channels
    assert counts["sample4geo"] == 1
    assert counts["dac"] == 1 + 2_625_536 + heads + 200 + 2 * 1024
    assert counts["camp"] == 1 + 147_456 + 3


def test_classifier_of_method_has_a_branch_per_part() -> None:
    for name in PUBLISHED:
        network = RECIPES[name]().network
        with torch.device("meta"):
            classifier = LocationClassifier(network, LOCATIONS)
        assert len(classifier.branches) == network.parts
