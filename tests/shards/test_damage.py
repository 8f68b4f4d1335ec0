"""Damaged shards: found before they are embedded, trained on or extended, and made anew by the
command that packed them.
"""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jobs.training.driver import train
from jobs.training.recipes.pvda import smoke
from jobs.training.settings import TrainSettings
from pipeline.batches.settings import StreamConfig
from pipeline.batches.training import TrainingStream
from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.features.embed import plan_embedding
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.features.settings import EmbeddingSettings
from pipeline.features.table_writer import FeatureTableWriter
from pipeline.shards.manifest import DAMAGED_FILE, Shard, read_manifest
from pipeline.shards.pack import pack
from pipeline.shards.shard_set import open_shards
from pipeline.shards.verify import check_shard, verify
from tests.damaging import (
    REMEDIES,
    count_detected,
    damaged_versions,
    error_message,
    raising_if_missing,
)
from tests.shards.imagery import SOURCE, content, imagery, packing

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    root, out = imagery(tmp_path_factory.mktemp("root"), range(4)), tmp_path_factory.mktemp("out")
    pack(SOURCE, packing(root, out))
    return root, out


@pytest.fixture
def out(packed: tuple[Path, Path], tmp_path: Path) -> Path:
    """A set of shards to damage."""
    return Path(shutil.copytree(packed[1], tmp_path / "shards"))


def a_shard(out: Path) -> tuple[Shard, Path]:
    shard = read_manifest(str(out)).of(Split.TRAIN, View.DRONE)[0]
    return shard, out / f"{shard.name}.tar"


def test_reading_finds_each_damage_of_a_tar(out: Path) -> None:
    shard, tar = a_shard(out)
    look = raising_if_missing(tar, lambda: list(open_shards(str(out)).samples(shard, verify=True)))
    assert count_detected(tar, look, 200) == 201
    for data in damaged_versions(tar.read_bytes(), 60, seed=1):
        tar.write_bytes(data or b"")
        assert any(str(tar) in sentence for sentence in check_shard(str(out), shard))


def test_training_refuses_or_skips_damage(out: Path) -> None:
    """By default sizes are checked first, and each image's hash and name as it is read."""
    _, tar = a_shard(out)
    good, refused, left_out = tar.read_bytes(), 0, 0
    reading = StreamConfig(batch_size=2, image_size=16, seed=1, threads=1, shuffle_buffer=4)

    def batches() -> list[Any]:
        return list(TrainingStream(open_shards(str(out)), reading).epoch(0))

    expected = batches()
    for data in damaged_versions(good, 100):
        if data is None or len(data) != len(good):
            continue
        tar.write_bytes(data)
        found: list[Any] = []
        output = error_message(lambda found=found: found.extend(batches()))  # type: ignore[misc]
        refused += output is not None
        assert output is None or ("shards" in output and REMEDIES.search(output)), output
        for now, then in zip(
            (b for pair in found for b in pair),
            (b for pair in expected for b in pair),
            strict=False,
        ):
            intact = [key not in now.damaged for key in then.keys]
            assert np.array_equal(now.images_B3HW[intact], then.images_B3HW[intact])
            assert np.array_equal(now.location_B[intact], then.location_B[intact])
            left_out += len(now.damaged)
    assert refused > 5
    assert left_out > 5


def test_training_checks_sizes_or_every_byte(out: Path, tmp_path: Path) -> None:
    recipe = smoke(1)
    settings = TrainSettings(
        recipe=replace(recipe, batch_size=2), shards=str(out), out=str(tmp_path / "run"), workers=0
    )
    _, tar = a_shard(out)
    good = tar.read_bytes()
    for data in (None, good[:-512]):
        tar.unlink(missing_ok=True)
        if data is not None:
            tar.write_bytes(data)
        with pytest.raises(
            InputError,
            match=rf"1 shards cannot be used: {tar} (is missing|has).*make_shards.py --verify",
        ):
            train(settings)
    tar.write_bytes(good[:2000] + bytes([good[2000] ^ 1]) + good[2001:])
    with pytest.raises(
        InputError,
        match=rf"is damaged in \d places: {tar}.* has not the hash .*jobs/make_shards.py",
    ):
        train(replace(settings, verify=True))


def spoil(what: str, out: Path, shard: Shard) -> None:
    tar, part = out / f"{shard.name}.tar", out / f"records/{shard.name}.parquet"
    for path, word in ((tar, "tar"), (part, "part")):
        if f"{word} flipped" in what:
            data = bytearray(path.read_bytes())
            data[len(data) // 3] ^= 8
            path.write_bytes(data)
        if f"{word} gone" in what:
            path.unlink()


SPOILT = [
    "tar flipped",
    "tar gone",
    "part flipped",
    "part gone",
    "tar gone, part gone",
    "tar flipped, part flipped",
]


@pytest.mark.parametrize("what", SPOILT)
def test_repair_by_the_packing_command(what: str, packed: tuple[Path, Path], out: Path) -> None:
    (root, intact), (shard, _) = packed, a_shard(out)
    spoil(what, out, shard)
    wrong = verify(open_shards(str(out)), workers=0)
    assert wrong
    assert all(shard.name in sentence for sentence in wrong)
    others = {
        name: (out / name).stat().st_mtime_ns for name in content(out) if "000001.tar" in name
    }
    pack(SOURCE, packing(root, out))
    now = {name: (out / name).stat().st_mtime_ns for name in others}
    assert (now, verify(open_shards(str(out)), workers=0)) == (others, [])
    assert {name: data for name, data in content(out).items() if name.endswith(".tar")} == {
        name: data for name, data in content(intact).items() if name.endswith(".tar")
    }
    assert not (out / DAMAGED_FILE).exists()


@pytest.mark.parametrize("what", SPOILT)
def test_repair_of_an_extended_set(what: str, tmp_path: Path) -> None:
    first, second, out = (
        imagery(tmp_path / "a", range(3)),
        imagery(tmp_path / "b", range(3, 6)),
        tmp_path / "out",
    )
    pack(SOURCE, packing(first, out))
    manifest = pack(SOURCE, packing(second, out, extend=True))
    before = content(out)
    damaged = manifest.of(Split.TRAIN, View.DRONE)[1], manifest.shards[-1]
    for shard in damaged:
        spoil(what, out, shard)
    assert verify(open_shards(str(out)), workers=0)
    with pytest.raises(
        InputError,
        match=rf"1 shards of \S+ are damaged, .*--root {first}, then .*--root {second} --extend",
    ):
        pack(SOURCE, packing(first, out))
    assert pack(SOURCE, packing(second, out, extend=True)) == manifest
    assert verify(open_shards(str(out)), workers=0) == []
    same = (".tar", ".json") if "part" in what else (".tar", ".json", ".parquet")
    after = content(out)
    assert after.keys() == before.keys()
    assert all(after[name] == data for name, data in before.items() if name.endswith(same))


def test_repair_changed_imagery_leaves_the_set_alone(tmp_path: Path) -> None:
    first, second, out = (
        imagery(tmp_path / "a", range(3)),
        imagery(tmp_path / "b", range(3, 6)),
        tmp_path / "out",
    )
    pack(SOURCE, packing(first, out))
    manifest = pack(SOURCE, packing(second, out, extend=True))
    shard = manifest.shards[0]
    spoil("tar flipped", out, shard)
    verify(open_shards(str(out)), workers=0)
    before = content(out)
    for path in (tmp_path / "a").rglob("*.jp*g"):
        path.write_bytes(path.read_bytes()[:-2] + b"\0\xff\xd9")
    with pytest.raises(InputError, match="this imagery does not hold what they were packed from"):
        pack(SOURCE, packing(first, out))
    assert content(out) == before


def test_pending_shards_with_verify_finds_damaged_pages(
    out: Path, tmp_path: Path, ray_cluster: None
) -> None:
    manifest, table = read_manifest(str(out)), tmp_path / "table"
    for shard in manifest.shards:
        count = shard.samples
        rows = PartRows(
            keys=[f"{shard.name}-{number}" for number in range(count)],
            locations=["a"] * count,
            views=[shard.view] * count,
            splits=[shard.split] * count,
            lats=[None] * count,
            lons=[None] * count,
            embeddings_BD=np.eye(count, 8, dtype=np.float32),
        )
        footer = PartFooter(fingerprint="f" * 64, shard_sha256=shard.sha256, rows=count)
        write_part(str(table / f"{shard.name}.parquet"), rows, footer)

    def missing(settings: EmbeddingSettings) -> list[Shard]:
        writer = FeatureTableWriter(settings.out, "f" * 64, settings.dtype)
        return list(plan_embedding(settings, writer).pending)

    asked = EmbeddingSettings(shards=str(out), out=str(table))
    assert missing(replace(asked, verify=True)) == []
    path = table / f"{manifest.shards[1].name}.parquet"
    data = bytearray(path.read_bytes())
    data[60] ^= 1  # within the first page
    path.write_bytes(data)
    assert missing(asked) == []
    assert missing(replace(asked, verify=True)) == [manifest.shards[1]]
