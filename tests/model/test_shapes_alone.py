"""Networks laid out without weights."""

import pytest
import torch

from jobs.training.recipes import RECIPES
from model.pvda import FeatureEncoder
from model.shapes_alone import shapes_alone


@pytest.mark.parametrize("method", ["builtin", "paper", "fsra", "msba_style", "mccg"])
def test_shapes_alone_equal_those_of_the_network(method: str) -> None:
    config = RECIPES[method]().network
    before = torch.get_rng_state()
    with shapes_alone():
        laid_out = FeatureEncoder(config)
    assert all(tensor.is_meta for tensor in laid_out.parameters())
    assert torch.equal(torch.get_rng_state(), before)
    shapes = {name: tensor.shape for name, tensor in FeatureEncoder(config).state_dict().items()}
    assert {name: tensor.shape for name, tensor in laid_out.state_dict().items()} == shapes
