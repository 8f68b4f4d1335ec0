"""Photos are embedded as the gallery was, whatever its settings were, and by no other network."""

import io
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from jobs.encoding.photo_encoder import PhotoEncoder
from model.checkpoint import Checkpoint, dumps, fingerprint, loads
from model.config import PVDAConfig
from model.inference.embed import embed
from model.inference.precision import describe_preprocessing
from model.pvda import FeatureEncoder
from pipeline.batches.ordered import stack
from pipeline.core.errors import InputError
from pipeline.images.decode import decode
from pipeline.images.transforms import Resizer, preprocessing_name, resize


@pytest.fixture
def checkpoint(lively_encoder: FeatureEncoder) -> bytes:
    state = {"modules": {"encoder": lively_encoder.state_dict()}}
    config = PVDAConfig(backbone="resnet18", width=0.25, image_size=64, parts=2, part_dim=16)
    return dumps(
        Checkpoint(network=config, recipe={}, locations=[], epoch=0, history=[], state=state)
    )


def facts(
    checkpoint: bytes, resizer: Resizer = "torch", mirror: bool = True, precision: Any = "float32"
) -> dict[str, Any]:
    said = describe_preprocessing(f"{preprocessing_name(resizer)}, mirror {mirror}", precision)
    return {"fingerprint": fingerprint(loads(checkpoint), said)}


def photo(seed: int, size: int = 90) -> bytes:
    stream = io.BytesIO()
    noise = np.random.default_rng(seed).integers(0, 256, size=(8, 8, 3), dtype=np.uint8)
    Image.fromarray(resize(noise, size)).save(stream, "JPEG")
    return stream.getvalue()


@pytest.mark.parametrize(("resizer", "mirror"), [("torch", True), ("pillow", False)])
def test_photo_encoder_embeds_as_the_gallery(
    checkpoint: bytes, lively_encoder: FeatureEncoder, resizer: Resizer, mirror: bool
) -> None:
    photos = [photo(1), photo(2)]
    encoder = PhotoEncoder(checkpoint, "last.pt", facts(checkpoint, resizer, mirror))
    found_QD, rejected = encoder.encode(photos)
    images_B3HW = torch.from_numpy(stack([resize(decode(data), 64, resizer) for data in photos]))
    assert rejected == [None, None]
    assert np.allclose(found_QD, embed(lively_encoder, images_B3HW, mirror).numpy(), atol=1e-5)


def test_photo_encoder_takes_the_precision_of_the_index(checkpoint: bytes) -> None:
    encoder = PhotoEncoder(checkpoint, "last.pt", facts(checkpoint, precision="bfloat16"))
    assert encoder.precision == "bfloat16"


def test_photo_encoder_reports_damaged_photo_in_order(checkpoint: bytes) -> None:
    encoder = PhotoEncoder(checkpoint, "last.pt", facts(checkpoint))
    photos = [photo(1), photo(2)[:-40], b"", photo(3)]
    found_QD, rejected = encoder.encode(photos, ["a", "b", "c", "d"])
    alone_QD, _ = encoder.encode([photo(3)])
    assert found_QD.shape == (2, encoder.dimension)
    assert np.allclose(found_QD[1], alone_QD[0], atol=1e-5)
    assert [one and (one.path, one.reason) for one in rejected] == [
        None, ("b", "truncated image"), ("c", "empty file"), None,
    ]  # fmt: skip


def test_photo_encoder_without_photos_gives_no_rows(checkpoint: bytes) -> None:
    encoder = PhotoEncoder(checkpoint, "last.pt", facts(checkpoint))
    assert encoder.encode([])[0].shape == (0, encoder.dimension)


def test_photo_encoder_rejects_another_network(checkpoint: bytes) -> None:
    with pytest.raises(InputError, match=r"last.pt did not make this index.*abcabcabcabc"):
        PhotoEncoder(checkpoint, "last.pt", {"fingerprint": "abc" * 20})
