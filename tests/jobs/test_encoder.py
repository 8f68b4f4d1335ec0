"""A checkpoint as the embedder's workers build it: the same images to check it by each time, and a
fingerprint that tells.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from jobs.encoding import encoder as encoders
from jobs.encoding.encoder import PROBE_IMAGES, first_images, make_encoder_spec
from jobs.encoding.settings import EncoderSettings
from jobs.training.recipes import smoke
from jobs.training.settings import RunConfig
from jobs.training.state import initial_checkpoint
from model.checkpoint import build_encoder, loads
from model.inference.embed import embed
from model.inference.int8 import PrecisionError
from pipeline.core.errors import InputError
from pipeline.core.records import Split
from pipeline.features.embed import embed_gallery
from pipeline.features.settings import EmbeddingSettings
from pipeline.features.table import open_table
from pipeline.images.transforms import Resizer
from pipeline.shards.shard_set import open_or_scan


@pytest.fixture(scope="module")
def checkpoint(tiny_shards: str) -> bytes:
    return initial_checkpoint(
        RunConfig(shards=tiny_shards, out="none", recipe=replace(smoke(1), batch_size=2))
    )


def asked(shards: str, **changes: object) -> EmbeddingSettings:
    return EmbeddingSettings(**({"shards": shards, "out": "none"} | changes))  # type: ignore[arg-type]


def images_of(
    embedding: EmbeddingSettings, size: int, resizer: Resizer, count: int
) -> encoders.Bytes:
    shards = open_or_scan(embedding.shards, embedding.split, embedding.view)
    return first_images(shards, size, resizer, count)


def test_check_images_are_constant_and_of_every_view(
    tiny_shards: str,
) -> None:
    first, again = (images_of(asked(tiny_shards), 32, "torch", 12) for _ in range(2))
    assert first.shape == (12, 3, 32, 32)
    assert np.array_equal(first, again)
    # Queries and gallery may be embedded one after the other: what calibrates int8 must not depend
    # on it.
    assert np.array_equal(first, images_of(asked(tiny_shards, split=Split.QUERY), 32, "torch", 12))


def test_encoder_spec_reports_shard_without_decodable_image(
    tiny_shards: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(encoders, "decode_samples", lambda samples, *given: iter([]))
    with pytest.raises(InputError, match="none of the first images of"):
        images_of(asked(tiny_shards), 32, "torch", PROBE_IMAGES)


def test_worker_encoder_equals_plain_encoder(tiny_shards: str, checkpoint: bytes) -> None:
    made = make_encoder_spec(checkpoint, "it", asked(tiny_shards)).factory(1)
    images = images_of(asked(tiny_shards), 64, "torch", 5)
    plain = embed(build_encoder(loads(checkpoint)), torch.from_numpy(images)).numpy()
    assert np.abs(made(images) - plain).max() < 1e-4
    assert "folded encoder in float32: cosine with the plain one 1.0" in made.remarks[-1]  # type: ignore[attr-defined]


def test_fingerprint_includes_settings_that_change_numbers(
    tiny_shards: str, checkpoint: bytes
) -> None:
    def fingerprint(**changes: Any) -> str:
        return make_encoder_spec(
            checkpoint, "it", asked(tiny_shards), EncoderSettings(**changes)
        ).fingerprint

    assert fingerprint() == fingerprint(precision="float32") == fingerprint(compiling="never")
    assert (
        len(
            {
                fingerprint(),
                fingerprint(mirror=False),
                fingerprint(resizer="pillow"),
                fingerprint(precision="bfloat16"),
            }
        )
        == 4
    )


def test_int8_unavailable_is_rejected_before_workers(
    tiny_shards: str, checkpoint: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without(device: str) -> None:
        raise PrecisionError("this CPU has none; choose --precision float32")

    monkeypatch.setattr(encoders, "require_int8", without)
    with pytest.raises(InputError, match="choose --precision float32"):
        make_encoder_spec(checkpoint, "it", asked(tiny_shards), EncoderSettings(precision="int8"))


def test_encoder_remarks_reach_the_terminal(
    tmp_path: Path,
    tiny_shards: str,
    checkpoint: bytes,
    ray_cluster: None,
    capsys: pytest.CaptureFixture[str],
) -> None:
    embedding = asked(tiny_shards, out=str(tmp_path), split=Split.QUERY)
    embed_gallery(embedding, make_encoder_spec(checkpoint, "it", embedding))
    assert "folded encoder in float32" in capsys.readouterr().err
    assert open_table(str(tmp_path)).rows > 0
