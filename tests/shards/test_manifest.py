"""Packing: the source's own bytes, the same tars whatever the parallelism, and nothing refused in
silence.
"""

import hashlib
import io
import json
import shutil
import tarfile
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import webdataset
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from pipeline.core import json_files, storage
from pipeline.core.errors import InputError
from pipeline.core.records import ImageRecord, Split, View
from pipeline.shards.manifest import read_manifest
from pipeline.shards.pack import pack
from pipeline.shards.pack_tars import TooManyRejected
from pipeline.shards.plan import ShardSize, plan_shards
from pipeline.shards.settings import PackingSettings
from pipeline.sources.university1652 import University1652


def settings(root: Path, out: Path, **changes: object) -> PackingSettings:
    given = {"root": str(root), "out": str(out), "samples_per_shard": 8}
    return PackingSettings(**(given | changes))  # type: ignore[arg-type]


def jpeg(path: Path, seed: int = 0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 255, (40, 48, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path, "JPEG")


def sample_set(root: Path) -> None:
    for place in ("0001", "0002"):
        jpeg(root / "train/satellite" / place / f"{place}.jpg", 1)
        for number in range(3):
            jpeg(root / "train/drone" / place / f"image-{number:02d}.jpeg", number)


@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)  # webdataset leaves the tar open
def test_shard_opens_with_webdataset_and_tarfile(tiny_shards: str) -> None:
    manifest = read_manifest(tiny_shards)
    shard = manifest.of(Split.GALLERY, View.DRONE)[0]
    path = Path(tiny_shards) / f"{shard.name}.tar"
    with tarfile.open(path) as tar:
        members = tar.getnames()
        assert len(members) == 2 * shard.samples
        assert {member.mtime for member in tar.getmembers()} == {0}
    samples = list(webdataset.WebDataset(str(path), shardshuffle=False))
    assert len(samples) == shard.samples
    facts = json.loads(samples[0]["json"])
    assert facts["sha256"] == hashlib.sha256(samples[0]["jpg"]).hexdigest()
    assert (facts["view"], facts["split"], facts["width"], facts["height"]) == (
        "drone",
        "gallery",
        64,
        64,
    )
    assert facts["key"] == samples[0]["__key__"]
    assert facts["geotag"]["lat"] is not None
    assert facts["geotag"]["altitude_m"] > 0
    assert path.stat().st_size == shard.bytes
    assert hashlib.sha256(path.read_bytes()).hexdigest() == shard.sha256


def test_pack_copies_every_image_once(tiny_world: Path, tiny_shards: str) -> None:
    packed = []
    for shard in read_manifest(tiny_shards).shards:
        with tarfile.open(Path(tiny_shards) / f"{shard.name}.tar") as tar:
            images = [member for member in tar if not member.name.endswith(".json")]
            packed += [stream.read() for image in images if (stream := tar.extractfile(image))]
    source = [
        path.read_bytes() for path in tiny_world.rglob("*.jp*g") if ".parts" not in path.parts
    ]
    assert sorted(packed) == sorted(source)


def test_manifest_classes_are_sorted_locations(tiny_world: Path, tiny_shards: str) -> None:
    assert list(read_manifest(tiny_shards).classes) == sorted(
        path.name for path in (tiny_world / "train/drone").iterdir()
    )


def test_pack_again_gives_the_same_bytes(
    tmp_path: Path, ray_cluster: None, capsys: pytest.CaptureFixture[str]
) -> None:
    sample_set(tmp_path / "root")
    first = pack(University1652(), settings(tmp_path / "root", tmp_path / "a", samples_per_shard=3))
    second = pack(
        University1652(), settings(tmp_path / "root", tmp_path / "b", samples_per_shard=3)
    )
    assert first.shards == second.shards
    assert (
        pack(University1652(), settings(tmp_path / "root", tmp_path / "a", samples_per_shard=3))
        == first
    )
    assert "nothing to do" in capsys.readouterr().err
    with pytest.raises(InputError, match="another samples_per_shard"):
        pack(University1652(), settings(tmp_path / "root", tmp_path / "a", samples_per_shard=4))


def test_pack_rejects_bad_files_with_reasons(tmp_path: Path, ray_cluster: None) -> None:
    root = tmp_path / "root"
    sample_set(root)
    drone = root / "train/drone/0001"
    (drone / "empty.jpeg").write_bytes(b"")
    (drone / "text.jpeg").write_bytes(b"hello, I am no image")
    intact = (drone / "image-00.jpeg").read_bytes()
    (drone / "cut.jpeg").write_bytes(intact[: len(intact) // 2])
    (drone / "Thumbs.db").write_bytes(b"x")
    jpeg(root / "train/drone/stray.jpeg")
    jpeg(drone / "image-00.jpg")  # the key of image-00.jpeg
    manifest = pack(University1652(), settings(root, tmp_path / "out", max_bad_fraction=0.9))
    assert sum(shard.samples for shard in manifest.shards) == 8
    assert manifest.rejected == 5
    rows = pq.read_table(tmp_path / "out/rejected.parquet").to_pylist()
    reasons = {Path(row["path"]).name: row["reason"] for row in rows}
    assert reasons == {
        "empty.jpeg": "empty file",
        "text.jpeg": "not an image",
        "cut.jpeg": "truncated image",
        "stray.jpeg": "wrong folder",
        "image-00.jpg": "same name twice",
    }


def test_pack_too_many_bad_files_leaves_no_manifest(tmp_path: Path, ray_cluster: None) -> None:
    sample_set(tmp_path / "root")
    (tmp_path / "root/train/drone/0001/empty.jpeg").write_bytes(b"")
    with pytest.raises(TooManyRejected, match=r"1 of 9 images were refused.*empty file \(1\)"):
        pack(University1652(), settings(tmp_path / "root", tmp_path / "out"))
    assert (tmp_path / "out/rejected.parquet").exists()
    with pytest.raises(InputError, match="not a finished set of shards"):
        read_manifest(str(tmp_path / "out"))


def test_scan_missing_and_empty_folder_differ(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no folder"):
        list(University1652().scan(str(tmp_path / "nowhere")))
    with pytest.raises(InputError, match="no images below"):
        list(University1652().scan(str(tmp_path)))


def test_scan_street_images_on_request(tmp_path: Path) -> None:
    sample_set(tmp_path)
    jpeg(tmp_path / "train/street/0001/1.jpg")
    assert len([f for f in University1652().scan(str(tmp_path)) if isinstance(f, ImageRecord)]) == 8
    assert len(list(University1652(views=tuple(View)).scan(str(tmp_path)))) == 9


def test_read_manifest_refuses_damage_with_the_remedy(tmp_path: Path, tiny_shards: str) -> None:
    content = json_files.read_checksummed(storage.join(tiny_shards, "manifest.json"))
    for damage in ({"schema_version": 9}, {"shards": [{"name": "x"}]}):
        json_files.write_checksummed(str(tmp_path / "manifest.json"), content | damage)
        with pytest.raises(InputError, match="again"):
            read_manifest(str(tmp_path))
    (tmp_path / "manifest.json").write_bytes(b"{")
    with pytest.raises(InputError, match="is damaged"):
        read_manifest(str(tmp_path))


@given(
    st.lists(
        st.tuples(st.sampled_from(Split), st.sampled_from(View), st.integers(0, 99)), unique=True
    ),
    st.integers(1, 9),
)
def test_plan_holds_every_image_once(images: list[tuple[Split, View, int]], size: int) -> None:
    records = [ImageRecord(path=f"/{n}.jpg", split=s, view=v, location="l") for s, v, n in images]
    plans, twice = plan_shards(records, ShardSize(samples_per_shard=size))
    assert not twice
    assert sorted(r.key for plan in plans for r in plan.records) == sorted(r.key for r in records)
    assert all(
        len(plan.records) <= size
        and {(r.split, r.view) for r in plan.records} == {(plan.split, plan.view)}
        for plan in plans
    )
    assert plan_shards(reversed(records), ShardSize(samples_per_shard=size))[0] == plans


def test_pack_keeps_png(tmp_path: Path, ray_cluster: None) -> None:
    path = tmp_path / "root/train/satellite/0001/0001.PNG"
    path.parent.mkdir(parents=True)
    Image.fromarray(np.zeros((8, 9, 3), np.uint8)).save(path)
    pack(University1652(), settings(tmp_path / "root", tmp_path / "out"))
    shutil.rmtree(tmp_path / "root")
    with tarfile.open(tmp_path / "out/train-satellite-000000.tar") as tar:
        png = tar.extractfile("train-satellite-0001-0001.png")
        assert png is not None
        assert Image.open(io.BytesIO(png.read())).size == (9, 8)
