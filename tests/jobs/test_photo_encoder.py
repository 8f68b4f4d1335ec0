"""Photos are encoded as the gallery was, by the encoding in the index, and by no other network."""

import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from jobs.encoding.encoder import encoder_fingerprint
from jobs.encoding.photo_encoder import PhotoEncoder
from model.checkpoint import Checkpoint, dumps, loads
from model.config import PVDAConfig
from model.inference.embed import embed
from model.pvda import FeatureEncoder
from pipeline.batches.ordered import stack
from pipeline.core.errors import InputError
from pipeline.features.encoding import EncodingConfig
from pipeline.images.decode import decode
from pipeline.images.transforms import Resizer, resize

pytestmark = pytest.mark.slow


@pytest.fixture
def checkpoint(lively_encoder: FeatureEncoder) -> bytes:
    state = {"modules": {"encoder": lively_encoder.state_dict()}}
    config = PVDAConfig(backbone="resnet18", width=0.25, image_size=64, parts=2, part_dim=16)
    return dumps(
        Checkpoint(network=config, recipe={}, locations=[], epoch=0, history=[], state=state)
    )


def identity_of(
    checkpoint: bytes, resizer: Resizer = "torch", mirror: bool = True, precision: Any = "float32"
) -> tuple[str, EncodingConfig]:
    """Fingerprint and encoding, as the metadata of an index has them."""
    encoding = EncodingConfig(mirror=mirror, resizer=resizer, precision=precision)
    return encoder_fingerprint(loads(checkpoint), encoding), encoding


def photo(seed: int, size: int = 90) -> bytes:
    stream = io.BytesIO()
    noise = np.random.default_rng(seed).integers(0, 256, size=(8, 8, 3), dtype=np.uint8)
    Image.fromarray(resize(noise, size)).save(stream, "JPEG")
    return stream.getvalue()


@pytest.mark.parametrize(("resizer", "mirror"), [("torch", True), ("pillow", False)])
def test_photo_encoder_embeds_as_the_gallery_was(
    checkpoint: bytes, lively_encoder: FeatureEncoder, resizer: Resizer, mirror: bool
) -> None:
    photos = [photo(1), photo(2)]
    encoder = PhotoEncoder(checkpoint, "last.pt", *identity_of(checkpoint, resizer, mirror))
    found_QD, rejected = encoder.encode(photos)
    images_B3HW = torch.from_numpy(stack([resize(decode(data), 64, resizer) for data in photos]))
    assert rejected == [None, None]
    assert np.allclose(found_QD, embed(lively_encoder, images_B3HW, mirror).numpy(), atol=1e-5)


def test_photo_encoder_takes_the_precision_of_the_index(checkpoint: bytes) -> None:
    encoder = PhotoEncoder(checkpoint, "last.pt", *identity_of(checkpoint, precision="bfloat16"))
    assert encoder.encoding.precision == "bfloat16"
    assert "encoder in bfloat16" in encoder.remarks[-1]


def test_encode_reports_a_damaged_photo_and_keeps_the_order(checkpoint: bytes) -> None:
    encoder = PhotoEncoder(checkpoint, "last.pt", *identity_of(checkpoint))
    photos = [photo(1), photo(2)[:-40], b"", photo(3)]
    found_QD, rejected = encoder.encode(photos, ["a", "b", "c", "d"])
    alone_QD, _ = encoder.encode([photo(3)])
    assert found_QD.shape == (2, encoder.dimension)
    assert np.allclose(found_QD[1], alone_QD[0], atol=1e-5)
    assert [one and (one.path, one.reason) for one in rejected] == [
        None,
        ("b", "truncated image"),
        ("c", "empty file"),
        None,
    ]


def test_encode_of_no_photo_gives_no_rows(checkpoint: bytes) -> None:
    encoder = PhotoEncoder(checkpoint, "last.pt", *identity_of(checkpoint))
    assert encoder.encode([])[0].shape == (0, encoder.dimension)


def test_photo_encoder_refuses_another_network(checkpoint: bytes) -> None:
    _, encoding = identity_of(checkpoint)
    with pytest.raises(InputError, match=r"last.pt did not make this index.*abcabcabcabc"):
        PhotoEncoder(checkpoint, "last.pt", "abc" * 20, encoding)


def test_photo_encoder_refuses_another_encoding(checkpoint: bytes) -> None:
    fingerprint, _ = identity_of(checkpoint)
    _, pillow = identity_of(checkpoint, "pillow")
    with pytest.raises(InputError, match=r"last.pt did not make this index"):
        PhotoEncoder(checkpoint, "last.pt", fingerprint, pillow)


def test_photo_encoder_refuses_an_index_of_imported_features(checkpoint: bytes) -> None:
    with pytest.raises(InputError, match=r"another program made.*jobs/embed_gallery\.py"):
        PhotoEncoder(checkpoint, "last.pt", "f" * 64, None)


def test_photos_of_an_int8_index_are_encoded_in_float32(
    checkpoint: bytes, lively_encoder: FeatureEncoder
) -> None:
    encoding = EncodingConfig(mirror=True, resizer="torch", precision="int8", calibration="c" * 8)
    fingerprint = encoder_fingerprint(loads(checkpoint), encoding)
    encoder = PhotoEncoder(checkpoint, "last.pt", fingerprint, encoding)
    assert (encoder.fingerprint, encoder.encoding) == (fingerprint, encoding)
    image_HW3 = encoder.to_input(decode(photo(1)))
    expected_BE = embed(lively_encoder, torch.from_numpy(stack([image_HW3]))).numpy()
    assert np.allclose(encoder.encode([photo(1)])[0], expected_BE, atol=1e-5)
    with pytest.raises(InputError, match=r"last.pt did not make this index"):
        PhotoEncoder(checkpoint, "last.pt", fingerprint, replace(encoding, calibration="d" * 8))
