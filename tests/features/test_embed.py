"""Embedding: a part per shard, each row once, finished parts skipped, other encoders rejected."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from pipeline.batches.ordered import CHANGED
from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.features.embed import embed_gallery
from pipeline.features.embed_worker import Encoder, EncoderSpec
from pipeline.features.encoding import EncodingConfig
from pipeline.features.part import read_footer
from pipeline.features.rejected import read_rejected
from pipeline.features.settings import EmbeddingSettings
from pipeline.features.table import open_table
from pipeline.shards.manifest import read_manifest
from pipeline.shards.shard_set import open_shards
from tests.damaging import update_checksum

ENCODING = EncodingConfig(mirror=False, resizer="torch", precision="float32")


def mean_colour_encoder(fingerprint: str = "f" * 64) -> EncoderSpec:
    """An encoder that needs no training: the unit vector of the mean colour."""

    def factory(threads: int) -> Encoder:
        def encode(images_B3HW: np.ndarray) -> np.ndarray:
            mean_B3 = images_B3HW.mean((2, 3)).astype(np.float32) + 1
            unit: np.ndarray = mean_B3 / np.linalg.norm(mean_B3, axis=1, keepdims=True)
            return unit

        return encode

    return EncoderSpec(fingerprint=fingerprint, encoding=ENCODING, image_size=32, factory=factory)


def test_embed_writes_one_row_per_image(
    tmp_path: Path, tiny_shards: str, ray_cluster: None
) -> None:
    out = str(tmp_path / "table")
    count = embed_gallery(
        EmbeddingSettings(shards=tiny_shards, out=out, batch_size=3), mean_colour_encoder()
    )
    manifest = read_manifest(tiny_shards)
    assert count == sum(shard.samples for shard in manifest.shards)
    table = open_table(out)
    assert sorted(table.parts) == sorted(f"{shard.name}.parquet" for shard in manifest.shards)
    samples = [
        sample for shard in manifest.shards for sample in open_shards(tiny_shards).samples(shard)
    ]
    labels = table.labels()
    assert labels.keys.tolist() == [sample.key for sample in samples]
    assert labels.locations.tolist() == [sample.metadata["location"] for sample in samples]
    assert labels.lats.tolist() == [sample.metadata["geotag"]["lat"] for sample in samples]
    assert np.allclose(np.linalg.norm(table.embeddings(), axis=1), 1, atol=1e-6)


def test_embed_rerun_embeds_missing_parts_only(tmp_path: Path, tiny_shards: str) -> None:
    settings = EmbeddingSettings(
        workers=0, shards=tiny_shards, out=str(tmp_path), split=Split.GALLERY, view=View.DRONE
    )
    shards = read_manifest(tiny_shards).of(Split.GALLERY, View.DRONE)
    assert len(shards) > 1
    assert embed_gallery(settings, mean_colour_encoder()) == sum(shard.samples for shard in shards)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    times = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert embed_gallery(settings, mean_colour_encoder()) == 0
    lost = tmp_path / f"{shards[0].name}.parquet"
    lost.unlink()
    assert embed_gallery(settings, mean_colour_encoder()) == shards[0].samples
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert all(
        path.stat().st_mtime_ns == times[path.name] for path in tmp_path.iterdir() if path != lost
    )


def test_embed_rejects_table_of_another_network(tmp_path: Path, tiny_shards: str) -> None:
    settings = EmbeddingSettings(
        workers=0, shards=tiny_shards, out=str(tmp_path), split=Split.QUERY, view=View.SATELLITE
    )
    embed_gallery(settings, mean_colour_encoder())
    with pytest.raises(
        InputError, match=r"was made by network f+, this checkpoint is g+; choose another --out"
    ):
        embed_gallery(settings, mean_colour_encoder("g" * 64))


def test_embed_names_absent_split_or_view(tmp_path: Path, tiny_shards: str) -> None:
    with pytest.raises(InputError, match="none of it was asked for"):
        embed_gallery(
            EmbeddingSettings(shards=tiny_shards, out=str(tmp_path), view=View.STREET),
            mean_colour_encoder(),
        )
    with pytest.raises(InputError, match="not a finished set of shards"):
        embed_gallery(
            EmbeddingSettings(shards=str(tmp_path), out=str(tmp_path)), mean_colour_encoder()
        )


def test_embed_skips_and_reports_undecodable_image(
    tmp_path: Path, tiny_shards: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Packing rejects such images; this one was changed later, with the checksums of tar and
    manifest.
    """
    shard = read_manifest(tiny_shards).of(Split.QUERY, View.SATELLITE)[0]
    data = bytearray((Path(tiny_shards) / f"{shard.name}.tar").read_bytes())
    start = data.index(b"\xff\xd8\xff")  # the first JPEG loses its beginning
    data[start : start + 3] = b"\0\0\0"
    shutil.copytree(tiny_shards, tmp_path, dirs_exist_ok=True)
    (tmp_path / f"{shard.name}.tar").write_bytes(data)
    update_checksum(tmp_path, shard.name)
    settings = EmbeddingSettings(
        workers=0,
        shards=str(tmp_path),
        out=str(tmp_path / "table"),
        split=Split.QUERY,
        view=View.SATELLITE,
    )
    embed_gallery(settings, mean_colour_encoder())
    footer = read_footer(str(tmp_path / "table" / f"{shard.name}.parquet"))
    assert footer.rows == shard.samples - 1
    assert [rejection.reason for rejection in footer.rejected] == [CHANGED]
    [listed] = read_rejected(str(tmp_path / "table")).to_pylist()
    assert (listed["shard"], listed["key"], listed["reason"]) == (
        shard.name,
        footer.rejected[0].path,
        CHANGED,
    )
    assert embed_gallery(settings, mean_colour_encoder()) == 0


def test_embed_accepts_uris(tmp_path: Path, tiny_shards: str) -> None:
    out = (tmp_path / "table").as_uri()
    settings = EmbeddingSettings(
        workers=0, shards=Path(tiny_shards).as_uri(), out=out, split=Split.QUERY, view=View.DRONE
    )
    assert embed_gallery(settings, mean_colour_encoder()) == open_table(out).rows > 0
