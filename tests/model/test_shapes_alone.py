"""Networks laid out without drawing their weights."""

import pytest
import torch

from jobs.training.recipes import RECIPES
from model.pvda import FeatureEncoder
from model.shapes_alone import shapes_alone, weights_follow

METHODS = ["builtin", "paper", "fsra", "msba_style", "mccg", "qdfl"]


@pytest.mark.parametrize("method", METHODS)
def test_networks_laid_out_equal_drawn_ones(method: str) -> None:
    config = RECIPES[method]().network
    drawn = FeatureEncoder(config)
    before = torch.get_rng_state()
    with shapes_alone():
        laid_out = FeatureEncoder(config)
    with weights_follow():
        loaded = FeatureEncoder(config)
    assert torch.equal(torch.get_rng_state(), before)
    assert all(tensor.is_meta for tensor in laid_out.parameters())
    shapes = {name: tensor.shape for name, tensor in drawn.state_dict().items()}
    assert {name: tensor.shape for name, tensor in laid_out.state_dict().items()} == shapes
    loaded.load_state_dict(drawn.state_dict())
    found = dict([*loaded.named_parameters(), *loaded.named_buffers()])
    for name, tensor in [*drawn.named_parameters(), *drawn.named_buffers()]:
        assert torch.equal(tensor, found.pop(name)), name
    assert not found
