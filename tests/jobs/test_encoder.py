"""The encoder that a worker builds from a checkpoint: its probe images, its fingerprint, and its
agreement with the plain encoder.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from jobs.encoding import encoder as encoder_module
from jobs.encoding import probe_images
from jobs.encoding.encoder import (
    absolute_checkpoint,
    make_encoder_spec,
    read_checkpoint_bytes,
)
from jobs.encoding.probe_images import PROBE_IMAGES, ImageBytes, first_images
from jobs.encoding.settings import EncoderSettings
from jobs.stages.export_weights import export_weights
from jobs.stages.settings import ExportWeightsSettings
from jobs.training.recipes.pvda import smoke
from jobs.training.settings import RunConfig
from model.checkpoint import build_encoder, dumps, loads
from model.inference.embed import embed
from model.inference.int8 import PrecisionError
from model.weights.builtin import BUILTIN, read_builtin
from pipeline.core.errors import InputError
from pipeline.core.records import Split
from pipeline.features.embed import embed_gallery
from pipeline.features.encoding import EncodingConfig
from pipeline.features.settings import EmbeddingSettings
from pipeline.features.table import open_table
from pipeline.images.transforms import Resizer
from pipeline.shards.shard_set import open_or_scan
from tests.jobs.tiny_runs import initial_checkpoint

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def checkpoint(tiny_shards: str) -> bytes:
    return initial_checkpoint(
        RunConfig(shards=tiny_shards, out="none", recipe=replace(smoke(1), batch_size=2))
    )


def settings_of(shards: str, **changes: object) -> EmbeddingSettings:
    given = {"shards": shards, "out": "none"} | changes
    return EmbeddingSettings(**given)  # type: ignore[arg-type]


def images_of(embedding: EmbeddingSettings, size: int, resizer: Resizer, count: int) -> ImageBytes:
    shards = open_or_scan(embedding.shards, embedding.split, embedding.view)
    return first_images(shards, size, resizer, count)


def test_first_images_are_the_same_for_every_split(tiny_shards: str) -> None:
    first, again = (images_of(settings_of(tiny_shards), 32, "torch", 12) for _ in range(2))
    assert first.shape == (12, 3, 32, 32)
    assert np.array_equal(first, again)
    # Queries and gallery may be embedded one after the other: the images that calibrate int8 must
    # not depend on it.
    of_queries = images_of(settings_of(tiny_shards, split=Split.QUERY), 32, "torch", 12)
    assert np.array_equal(first, of_queries)


def test_first_images_refuse_shards_without_a_decodable_image(
    tiny_shards: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(probe_images, "decode_samples", lambda samples, *given: iter([]))
    with pytest.raises(InputError, match="none of the first images of"):
        images_of(settings_of(tiny_shards), 32, "torch", PROBE_IMAGES)


def test_worker_encoder_agrees_with_the_plain_encoder(tiny_shards: str, checkpoint: bytes) -> None:
    encoder = make_encoder_spec(checkpoint, "it", settings_of(tiny_shards)).factory(1)
    images = images_of(settings_of(tiny_shards), 64, "torch", 5)
    plain = embed(build_encoder(loads(checkpoint)), torch.from_numpy(images)).numpy()
    assert np.abs(encoder(images) - plain).max() < 1e-4
    last = encoder.remarks[-1]  # type: ignore[attr-defined]
    assert "folded encoder in float32: cosine with the plain one 1.0" in last


def test_fingerprint_covers_the_encoding(tiny_shards: str, checkpoint: bytes) -> None:
    def fingerprint(**changes: Any) -> str:
        settings = EncoderSettings(**changes)
        return make_encoder_spec(checkpoint, "it", settings_of(tiny_shards), settings).fingerprint

    assert fingerprint() == fingerprint(precision="float32") == fingerprint(compiling="never")
    different = {
        fingerprint(),
        fingerprint(mirror=False),
        fingerprint(resizer="pillow"),
        fingerprint(precision="bfloat16"),
    }
    assert len(different) == 4


def test_int8_unavailable_is_refused_before_any_worker_starts(
    tiny_shards: str, checkpoint: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unavailable(device: str) -> None:
        raise PrecisionError("this CPU has none; choose --precision float32")

    monkeypatch.setattr(encoder_module, "require_int8", unavailable)
    settings = EncoderSettings(precision="int8")
    with pytest.raises(InputError, match="choose --precision float32"):
        make_encoder_spec(checkpoint, "it", settings_of(tiny_shards), settings)


def precision_of(embedding: EmbeddingSettings, name: str = "builtin", **given: Any) -> str:
    """The precision that the built-in encoder takes; fails where it needs more than its bytes."""
    spec = make_encoder_spec(read_builtin(), name, embedding, EncoderSettings(**given))
    return spec.encoding.precision


def test_many_images_are_embedded_in_int8_where_it_pays(
    tiny_shards: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By the built-in encoder, whose recall in int8 is known, on CPUs that have it."""
    embedding = settings_of(tiny_shards)
    monkeypatch.setattr(encoder_module, "require_int8", lambda device: None)
    assert precision_of(embedding) == "float32", "few images"
    monkeypatch.setattr(encoder_module, "INT8_PAYS_FROM", 1)
    assert precision_of(embedding) == "int8"
    assert "in int8, which this CPU multiplies fast" in " ".join(capsys.readouterr().err.split())
    assert precision_of(embedding, "other.pt") == "float32", "whose recall in int8 is unknown"
    assert precision_of(embedding, precision="float32") == "float32"

    def unavailable(device: str) -> None:
        raise PrecisionError("this CPU has none")

    monkeypatch.setattr(encoder_module, "require_int8", unavailable)
    assert precision_of(embedding) == "float32"


def test_a_table_is_continued_in_its_precision(
    tmp_path: Path, tiny_shards: str, checkpoint: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A set that has grown past the limit would otherwise be refused its own table."""
    embedding = settings_of(tiny_shards, out=str(tmp_path), split=Split.QUERY, workers=0)
    spec = make_encoder_spec(read_builtin(), "builtin", embedding)
    embed_gallery(embedding, spec)
    monkeypatch.setattr(encoder_module, "require_int8", lambda device: None)
    monkeypatch.setattr(encoder_module, "INT8_PAYS_FROM", 1)
    assert precision_of(embedding) == "float32"
    assert precision_of(replace(embedding, out="none")) == "int8"


def test_table_records_the_encoding_and_remarks_are_printed(
    tmp_path: Path,
    tiny_shards: str,
    checkpoint: bytes,
    capsys: pytest.CaptureFixture[str],
) -> None:
    embedding = settings_of(tiny_shards, out=str(tmp_path), split=Split.QUERY, workers=0)
    spec = make_encoder_spec(checkpoint, "it", embedding, EncoderSettings(resizer="pillow"))
    embed_gallery(embedding, spec)
    assert "folded encoder in float32" in capsys.readouterr().err
    table = open_table(str(tmp_path))
    assert table.rows > 0
    assert table.encoding == spec.encoding
    assert spec.encoding == EncodingConfig(mirror=True, resizer="pillow", precision="float32")


@pytest.mark.slow
def test_mirror_images_are_summed_where_training_saw_them(
    tiny_shards: str, checkpoint: bytes
) -> None:
    settings = settings_of(tiny_shards)
    trained = loads(checkpoint)
    assert make_encoder_spec(checkpoint, "x.pt", settings).encoding.mirror
    augmentation = trained.recipe["augmentation"] | {"mirror": False}
    plain = dumps(replace(trained, recipe=trained.recipe | {"augmentation": augmentation}))
    assert not make_encoder_spec(plain, "x.pt", settings).encoding.mirror
    asked = make_encoder_spec(plain, "x.pt", settings, EncoderSettings(mirror=True))
    assert asked.encoding.mirror
    unknown = dumps(replace(trained, recipe={}))
    assert make_encoder_spec(unknown, "x.pt", settings).encoding.mirror


def test_builtin_is_a_checkpoint_by_name(tmp_path: Path) -> None:
    assert loads(read_checkpoint_bytes(BUILTIN)).network.backbone == "efficientnet_lite0"
    assert absolute_checkpoint(BUILTIN) == BUILTIN
    assert absolute_checkpoint("run/last.pt") == str(Path("run/last.pt").absolute())
    with pytest.raises(InputError, match=r"no checkpoint at .*; expected builtin, or a last\.pt"):
        read_checkpoint_bytes(str(tmp_path / "none.pt"))


def test_export_weights_writes_an_encoder_that_jobs_take(checkpoint: bytes, tmp_path: Path) -> None:
    (tmp_path / "last.pt").write_bytes(checkpoint)
    out = str(tmp_path / "small.safetensors")
    export_weights(ExportWeightsSettings(checkpoint=str(tmp_path / "last.pt"), out=out))
    found, whole = loads(read_checkpoint_bytes(out), out), loads(checkpoint)
    assert found.network == whole.network
    assert Path(out).stat().st_size < len(checkpoint) / 2
