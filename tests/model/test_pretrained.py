"""Weights of transformers' networks: a folder gives the outputs of the library's own model, and
others are refused.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from model.backbones.huggingface import import_transformers
from model.config import PVDAConfig
from model.errors import CheckpointError
from model.pvda import FeatureEncoder
from model.weights.start import load_start
from tests.model.small_transformers import SMALL, network_config, saved


@pytest.mark.slow
@torch.no_grad()
def test_folder_gives_the_outputs_of_transformers(small: str, tmp_path: Path) -> None:
    config = network_config(small)
    encoder = FeatureEncoder(config).eval()
    folder = saved(small, tmp_path / "saved")
    load_start(encoder, small, "random", str(folder))
    backbone, side = encoder.backbone, config.image_size + SMALL[small][0].stride
    images_B3HW = torch.randn(2, 3, config.image_size, side)
    kind: Any = getattr(import_transformers(), SMALL[small][0].model_class)
    public = kind.from_pretrained(folder).eval()
    options = {"interpolate_pos_encoding": True} if small == "vit_small" else {}
    expected = public(images_B3HW, **options).last_hidden_state
    maps_BCHW = backbone(images_B3HW)
    if expected.dim() == 3:
        cells = maps_BCHW.flatten(2).transpose(1, 2)
        assert expected.shape[1] - cells.shape[1] == {
            "vit_small": 1, "dinov2_small": 1, "dinov3_small": 5, "swin_tiny": 0
        }[small]  # fmt: skip
        expected = expected[:, -cells.shape[1] :]
        torch.testing.assert_close(cells, expected, rtol=0, atol=0)
    else:
        torch.testing.assert_close(maps_BCHW, expected, rtol=0, atol=0)
    assert float(maps_BCHW.std()) > 0.01


def test_unfit_folders_are_refused_in_a_sentence(small_vit: str, tmp_path: Path) -> None:
    folder = saved(small_vit, tmp_path / "good")
    encoder = FeatureEncoder(network_config(small_vit))

    def refusal(source: Path | str, backbone: str = small_vit) -> str:
        with pytest.raises(CheckpointError) as caught:
            load_start(encoder, backbone, "random", str(source))
        assert "\n" not in str(caught.value)
        return str(caught.value)

    def changed(name: str, **settings: Any) -> Path:
        other = Path(shutil.copytree(folder, tmp_path / name))
        config = json.loads((other / "config.json").read_text())
        (other / "config.json").write_text(json.dumps(config | settings))
        return other

    assert "type swin, expected vit" in refusal(changed("swin", model_type="swin"))
    assert "type None" in refusal(changed("none", model_type=None))
    code = changed("code", model_type="odd", auto_map={"AutoModel": "evil.Model"})
    assert "type odd, expected vit" in refusal(code)
    assert "num_attention_heads 4, expected 2" in refusal(changed("heads", num_attention_heads=4))
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "holds nothing, expected config.json and model.safetensors" in refusal(empty)
    weights = folder / "model.safetensors"
    assert "is one file, expected a folder with config.json" in refusal(weights)
    pickled = changed("pickled")
    (pickled / "model.safetensors").rename(pickled / "pytorch_model.bin")
    assert "can run code and are not read" in refusal(pickled)
    state = load_file(weights)
    for name, altered, sentence in (
        ("short", dict(list(state.items())[1:]), "lacks 1 tensors"),
        ("shape", state | {"layernorm.bias": torch.zeros(3)}, "cannot be read"),
        ("nan", state | {"layernorm.bias": torch.full((16,), torch.nan)}, "NaN or infinite"),
    ):
        other = changed(name)
        save_file(altered, other / "model.safetensors", {"format": "pt"})
        assert sentence in refusal(other)
    (other / "model.safetensors").write_bytes(b"\0" * 99)
    assert "cannot be read" in refusal(other)
    (other / "config.json").write_text("{")
    assert "cannot be read" in refusal(other)
    assert "is no name on the hub, expected hf:OWNER/NAME" in refusal("hf:vit")
    assert "one file for resnet18" in refusal_of_resnet(folder)
    with pytest.raises(CheckpointError, match="no package holds public weights of vit_small"):
        load_start(encoder, small_vit, "imagenet", None)


def refusal_of_resnet(folder: Path) -> str:
    encoder = FeatureEncoder(PVDAConfig(backbone="resnet18", width=0.25, image_size=64, parts=2))
    with pytest.raises(CheckpointError) as caught:
        load_start(encoder, "resnet18", "random", str(folder))
    return str(caught.value)


def test_hub_is_asked_for_safetensors_and_no_code(
    small_vit: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = saved(small_vit, tmp_path / "saved")
    encoder = FeatureEncoder(network_config(small_vit))
    kind: Any = type(encoder.backbone.network)
    read, read_config = kind.from_pretrained, kind.config_class.get_config_dict
    asked: dict[str, Any] = {}

    def from_hub(name: str, **options: Any) -> Any:
        asked.update(options | {"name": name})
        return read(folder, **options)

    monkeypatch.setattr(kind, "from_pretrained", from_hub)
    monkeypatch.setattr(
        kind.config_class, "get_config_dict", staticmethod(lambda name, **_: read_config(folder))
    )
    load_start(encoder, small_vit, "random", "hf:owner/vit-small")
    expected = load_file(folder / "model.safetensors")["embeddings.cls_token"]
    assert torch.equal(encoder.backbone.state_dict()["network.embeddings.cls_token"], expected)
    assert asked["name"] == "owner/vit-small"
    assert asked["use_safetensors"] is True
    assert asked["trust_remote_code"] is False
    assert asked["local_files_only"] is False

    def unreachable(name: str, **_: Any) -> Any:
        raise OSError("We couldn't connect to the hub\nand more lines")

    monkeypatch.setattr(kind.config_class, "get_config_dict", staticmethod(unreachable))
    with pytest.raises(CheckpointError, match=r"connect to the hub\), expected .* the folder$"):
        load_start(encoder, small_vit, "random", "hf:owner/vit-small")
