"""Checkpoints, weights and features from anywhere: content, or a sentence; no code is executed."""

import io
import pickle
import zipfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import scipy.io
import torch
from hypothesis import given
from hypothesis import strategies as st

from jobs.stages.import_weights import import_weights
from jobs.stages.settings import ImportWeightsSettings
from model.checkpoint import Checkpoint, build_encoder, dumps, fingerprint, loads
from model.config import PVDAConfig
from model.errors import CheckpointError
from model.pvda import FeatureEncoder
from model.weights.load import infer_backbone, parse_state_dict
from pipeline.core.errors import InputError
from pipeline.features.import_mat import import_features
from pipeline.features.settings import ImportSettings
from tests.fuzz.bounds import bounded, examples
from tests.fuzz.hostile import VALUES, damaged, twisted, values

NETWORK = PVDAConfig(backbone="resnet18", width=0.25, image_size=64, parts=2, part_dim=8)


@cache
def checkpoint() -> bytes:
    encoder = FeatureEncoder(NETWORK)
    return dumps(
        Checkpoint(
            network=NETWORK,
            recipe={"name": "made", "seed": 0},
            locations=["0001"],
            epoch=1,
            history=[{"epoch": 1}],
            state={"modules": {"encoder": encoder.state_dict()}},
        )
    )


@cache
def plain() -> dict[str, Any]:
    found: dict[str, Any] = torch.load(io.BytesIO(checkpoint()), weights_only=True)
    return found


def saved(value: Any) -> bytes:
    stream = io.BytesIO()
    torch.save(value, stream)
    return stream.getvalue()


def open_all(data: bytes) -> None:
    with bounded(CheckpointError):
        checkpoint_ = loads(data)
        build_encoder(checkpoint_)
        fingerprint(checkpoint_, "bicubic")


@given(st.data())
@examples(25)
def test_damaged_checkpoint_is_read_or_rejected(data: st.DataObject) -> None:
    intact = checkpoint()
    head = intact.find(
        b"PK\1\2"
    )  # flips in a weight are no damage that one could see; the pickle and the directory are
    content = (
        data.draw(damaged(intact, most=3, head=2000))
        if data.draw(st.booleans())
        else intact[:head] + data.draw(damaged(intact[head:]))
    )
    open_all(content)


@given(
    st.sampled_from(
        [
            "format",
            "network",
            "recipe",
            "history",
            "locations",
            "epoch",
            "step",
            "metric_sums",
            "state",
            "more",
        ]
    ),
    values,
    st.data(),
)
@examples(40)
def test_checkpoint_field_of_any_value_is_bounded(
    field: str, value: Any, data: st.DataObject
) -> None:
    if data.draw(st.booleans()) and field in plain():
        value = data.draw(twisted(plain()[field])) if field != "state" else {"modules": value}
    open_all(saved(plain() | {field: value}))


@pytest.mark.parametrize("network", [
    '{"width": 1e6, "backbone": "resnet18"}', '{"width": 1e300}',
    '{"image_size": 1000000000000, "parts": 10000000}',
    '{"part_dim": 1000000000000}',
    '{"backbone": "18"}', '{"backbone": true}', '{"backbone": []}', '{"image_size": 64.5}',
    '{"parts": -1}', '{"parts": 0}', '{"width": NaN}',
    '{"width": -1}', "[]", "null", "[" * 100_000,
    '{"discriminator_channels": 1e9}', '{"ring_divisor": "x"}', '{"dropout": "x"}',
    '{"dropout": 7}',
])  # fmt: skip
def test_network_config_of_any_value_is_bounded(network: str) -> None:
    open_all(saved(plain() | {"network": network}))
    with bounded(CheckpointError):
        checkpoint_ = loads(saved(plain() | {"network": network}))
        assert checkpoint_.network.ring_divisor in ("box", "ring")


def strided(shape: tuple[int, ...]) -> torch.Tensor:
    return torch.zeros(1).as_strided(shape, (0,) * len(shape))


@pytest.mark.parametrize(
    "tensor",
    [
        strided((1 << 40,)),
        strided((1 << 20, 1 << 20)),
        torch.zeros(4).to_sparse(),
        torch.empty(3, device="meta"),
        torch.zeros(2, dtype=torch.complex64),
    ],
    ids=range(5),
)
def test_tensor_beyond_its_storage_is_rejected(tensor: torch.Tensor) -> None:
    state = plain()["state"]["modules"]["encoder"]
    name = next(iter(state))
    open_all(saved(plain() | {"state": {"modules": {"encoder": state | {name: tensor}}}}))
    open_all(saved(plain() | {"metric_sums": {"x": tensor}}))
    with bounded(CheckpointError):
        infer_backbone(
            parse_state_dict(
                saved({"conv1.weight": tensor, "layer1.0.conv1.weight": tensor}), "x.pth"
            ),
            "x",
        )


def test_zip_bomb_is_not_inflated() -> None:
    stream = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(checkpoint())) as old,
        zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as new,
    ):
        for name in old.namelist():
            data = old.read(name)
            new.writestr(name, data if not name.endswith("/data/0") else data + bytes(100_000_000))
    with pytest.raises(CheckpointError):
        loads(stream.getvalue())
    with pytest.raises(CheckpointError):
        parse_state_dict(stream.getvalue(), "x.pth")


class Trap:
    def __init__(self, what: Any, *words: Any) -> None:
        self.what, self.words = what, words

    def __reduce__(self) -> tuple[Any, ...]:
        return self.what, self.words


@pytest.mark.parametrize("protocol", range(6))
def test_pickled_code_is_not_executed(protocol: int, tmp_path: Path) -> None:
    sprung = tmp_path / "sprung"
    for trap in (
        Trap(Path.touch, sprung),
        Trap(exec, f"open({str(sprung)!r}, 'w')"),
        Trap(np.load, str(sprung), None, True),
    ):
        for data in (
            saved(plain() | {"epoch": trap}),
            pickle.dumps(trap, protocol),
            pickle.dumps(plain() | {"state": trap}, protocol),
        ):
            for reader in (
                loads,
                lambda given: parse_state_dict(given, "x.pth"),
                lambda given: parse_state_dict(given, "x.safetensors"),
            ):
                with pytest.raises(CheckpointError):
                    reader(data)
    assert not sprung.exists()


def laughs() -> bytes:
    """Lists of ten times the same list, forty deep: small as a pickle, endless for a reader."""
    value: Any = ["ha"]
    for _ in range(40):
        value = [value] * 10
    return saved(plain() | {"state": {"modules": {"encoder": {}}, "x": value}})


def test_exponential_nested_lists_are_rejected() -> None:
    open_all(laughs())
    with bounded(CheckpointError):
        parse_state_dict(laughs(), "x.pth")


@cache
def tensors(form: str) -> bytes:
    state = {
        "conv1.weight": torch.zeros(8, 3, 7, 7),
        "layer1.0.conv1.weight": torch.zeros(8, 8, 3, 3),
    }
    return safetensors.torch.save(state) if form == "safetensors" else saved(state)


@given(st.data(), st.sampled_from(["safetensors", "pth"]))
@examples(40)
def test_damaged_weights_file_is_read_or_rejected(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, form: str
) -> None:
    folder = tmp_path_factory.mktemp("weights")
    path = folder / f"x.{form}"
    path.write_bytes(data.draw(damaged(tensors(form), head=300)))
    for flag in ("torchvision", "lpn", "mccg", "qdfl"):
        with bounded(CheckpointError, InputError):
            import_weights(
                ImportWeightsSettings(
                    out=str(folder / "out.pt"),
                    image_size=data.draw(st.sampled_from([64, 0, -1, 10**12])),
                    **{flag: str(path)},
                )
            )
    assert {each.name for each in folder.iterdir()} <= {path.name, "out.pt"}


cells = st.sampled_from(
    [
        np.zeros((2, 4)),
        np.ones((2, 4), np.float32),
        np.ones((3, 4)),
        np.full((2, 4), np.nan),
        np.ones((2, 4), complex),
        np.array("x"),
        np.array(["a/b/c/d.jpg", "e"]),
        np.array([[1, 2]]),
        np.array([np.inf, 1]),
        np.zeros((0, 4)),
        np.ones((2, 0)),
        np.array([1e300, -1]),
        np.array([["x"], [1]], object),
        {"a": 1},
        np.array([["\0" * 4]]),
        np.array(["../../x/y/z", "a\nb"]),
    ]
)


@given(
    st.fixed_dictionaries(
        dict.fromkeys(("gallery_f", "query_f", "gallery_label", "query_label"), cells),
        optional=dict.fromkeys(("gallery_path", "query_path"), cells),
    ),
    st.data(),
)
@examples(8, share=0.1)
def test_foreign_features_are_read_or_rejected(
    tmp_path_factory: pytest.TempPathFactory, arrays: dict[str, Any], data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("mat")
    good = {
        "gallery_f": np.ones((2, 4), np.float32),
        "query_f": np.ones((2, 4), np.float32),
        "gallery_label": np.array([[1, 2]]),
        "query_label": np.array([[1, 2]]),
    }
    strange = data.draw(st.sets(st.sampled_from(sorted(arrays))))
    scipy.io.savemat(folder / "x.mat", good | {name: arrays[name] for name in strange})
    if data.draw(st.booleans()):
        (folder / "x.mat").write_bytes(
            data.draw(damaged((folder / "x.mat").read_bytes(), head=200))
        )
    with bounded(InputError):
        import_features(ImportSettings(mat=str(folder / "x.mat"), out=str(folder / "out")))
    assert {each.name for each in folder.iterdir()} <= {"x.mat", "out"}


def test_values_can_be_written_as_json() -> None:
    assert len(VALUES) > 20
