"""State dicts as people save them load as the plain one does, or are refused by name."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

from model.backbones.resnet import ResNet
from model.errors import CheckpointError
from model.weights.load import infer_backbone, load_backbone, read_state_dict
from model.weights.unwrap import MAX_DEPTH, find_state_dict, prefix_variants

pytestmark = pytest.mark.slow

State = dict[str, Tensor]


def tiny(seed: int = 1) -> ResNet:
    torch.manual_seed(seed)
    return ResNet("resnet18", 0.25)


def plain() -> State:
    return tiny().state_dict() | {"fc.weight": torch.ones(7, 128), "fc.bias": torch.zeros(7)}


def under(prefix: str, state: State) -> State:
    return {prefix + key: tensor for key, tensor in state.items()}


def lightning(state: State) -> dict[str, Any]:
    """The entries of a LightningModule's checkpoint."""
    return {
        "epoch": 3,
        "global_step": 96,
        "pytorch-lightning_version": "2.5.0",
        "state_dict": state,
        "loops": {"fit_loop": {"state_dict": {}}},
        "callbacks": {"ModelCheckpoint{'mode': 'min'}": {"best_model_score": torch.tensor(0.5)}},
        "optimizer_states": [{"state": {0: {"step": torch.tensor(9.0)}}, "param_groups": []}],
        "lr_schedulers": [],
        "hparams_name": "kwargs",
        "hyper_parameters": {"lr": 0.01},
    }


SAVED: dict[str, Callable[[State], Any]] = {
    "DataParallel": lambda state: under("module.", state),
    "torch.compile": lambda state: under("_orig_mod.", state),
    "compiled in DDP": lambda state: under("module._orig_mod.", state),
    "DDP in torch.compile": lambda state: under("_orig_mod.module.", state),
    "Lightning": lambda state: lightning(under("model.", state)),
    "Lightning, compiled": lambda state: lightning(under("model._orig_mod.", state)),
    "DDP in Lightning": lambda state: lightning(under("model.module.", state)),
    "FSDP": lambda state: {
        key.replace("layer1.", "layer1._fsdp_wrapped_module."): tensor
        for key, tensor in state.items()
    },
    "timm": lambda state: {"arch": "resnet18", "epoch": 9, "state_dict": state},
    "torchvision's training": lambda state: {
        "model": state,
        "optimizer": {"state": {0: {"momentum_buffer": torch.ones(2)}}, "param_groups": []},
        "epoch": 5,
    },
    "tutorial": lambda state: {"model_state_dict": under("module.", state), "loss": 0.3},
    "nested": lambda state: {"model": {"state_dict": under("model.model.", state)}, "step": 1},
    "averaged": lambda state: under("module.", state) | {"n_averaged": torch.tensor(4)},
}


@pytest.mark.parametrize("wrap", SAVED.values(), ids=SAVED)
def test_state_dict_as_people_save_it_loads(tmp_path: Path, wrap: Callable[[State], Any]) -> None:
    path = str(tmp_path / "theirs.pth")
    torch.save(wrap(plain()), path)
    state = read_state_dict(path)
    assert infer_backbone(state, path) == ("resnet18", 0.25)
    backbone = tiny(0)
    load_backbone(backbone, state, path)
    for key, tensor in tiny().state_dict().items():
        assert torch.equal(backbone.state_dict()[key], tensor)


def test_safetensors_with_prefix_loads(tmp_path: Path) -> None:
    path = str(tmp_path / "theirs.safetensors")
    safetensors.torch.save_file(under("module.", plain()), path)
    assert read_state_dict(path).keys() == plain().keys()


def test_prefixes_are_those_that_torch_adds() -> None:
    model = nn.Sequential(nn.Linear(2, 2))
    names = set(model.state_dict())
    wrapped: list[nn.Module] = [nn.DataParallel(model), AveragedModel(model)]
    for module in wrapped:
        found = set(find_state_dict(module.state_dict(), "x"))
        assert found - {"n_averaged"} == {f"module.{name}" for name in names}


def test_prefix_of_some_names_stays(tmp_path: Path) -> None:
    path = str(tmp_path / "two.pth")
    torch.save(under("model.", plain()) | {"criterion.weight": torch.ones(7)}, path)
    backbone = tiny(0)
    with pytest.raises(CheckpointError, match=r"criterion\.weight is unexpected"):
        load_backbone(backbone, read_state_dict(path), path)


def test_prefix_variants_of_hostile_names_are_few() -> None:
    variants = list(prefix_variants({"model." * 1000 + "x": torch.ones(1)}))
    assert len(variants) == MAX_DEPTH + 1
    assert list(prefix_variants({})) == [{}]


@pytest.mark.parametrize("number", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.float8_e5m2])
def test_weights_that_are_not_finite_are_refused(
    tmp_path: Path, number: float, dtype: torch.dtype
) -> None:
    state, path = plain(), str(tmp_path / "diverged.pth")
    spoiled = torch.zeros(16, 3, 7, 7)
    spoiled[0, 0, 0, :2] = number
    torch.save({"state_dict": under("module.", state | {"conv1.weight": spoiled.to(dtype)})}, path)
    with pytest.raises(
        CheckpointError,
        match=r"diverged\.pth: conv1\.weight has 2 of 2352 numbers that are NaN or infinite, exp",
    ):
        read_state_dict(path)


def test_weights_not_finite_count_the_other_tensors(tmp_path: Path) -> None:
    path = str(tmp_path / "diverged.pth")
    torch.save({key: torch.full_like(tensor, torch.nan) for key, tensor in plain().items()
                if tensor.is_floating_point()}, path)  # fmt: skip
    with pytest.raises(CheckpointError, match=r"conv1\.weight has .*\(101 more tensors likewise\)"):
        read_state_dict(path)


def test_two_state_dicts_are_refused_by_name(tmp_path: Path) -> None:
    path = str(tmp_path / "both.pth")
    torch.save({"state_dict": plain(), "model": {"net": under("module.", plain())}}, path)
    with pytest.raises(
        CheckpointError, match=r"both\.pth holds 2 state dicts \(state_dict, model\.net\), expected"
    ):
        read_state_dict(path)


def test_tensor_with_two_names_is_refused(tmp_path: Path) -> None:
    path = str(tmp_path / "twice.pth")
    torch.save(plain() | under("_orig_mod.", plain()), path)
    with pytest.raises(
        CheckpointError,
        match=r"twice\.pth holds conv1\.weight twice, as conv1\.weight and _orig_mod\.conv1\.weig",
    ):
        read_state_dict(path)


def test_other_entries_are_named(tmp_path: Path) -> None:
    path = str(tmp_path / "else.pth")
    torch.save({"teacher": plain(), "epoch": 3}, path)
    with pytest.raises(CheckpointError, match=r"\(teacher: OrderedDict, epoch: int\); expected"):
        read_state_dict(path)


@pytest.mark.parametrize(
    ("value", "named"),
    [
        (lightning(plain()) | {"hyper_parameters": argparse.Namespace(lr=1)}, "argparse.Namespace"),
        (nn.Sequential(nn.Linear(2, 2)), "torch.nn.modules.container.Sequential"),
    ],
    ids=["settings", "module"],
)
def test_object_beside_the_weights_is_named(tmp_path: Path, value: Any, named: str) -> None:
    path = str(tmp_path / "run.ckpt")
    torch.save(value, path)
    with pytest.raises(CheckpointError, match=rf"run\.ckpt holds an object of {named}, which"):
        read_state_dict(path)
