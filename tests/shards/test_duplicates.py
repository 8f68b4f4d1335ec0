"""Images that come twice are packed once; extending a finished set adds what it does not hold."""

from pathlib import Path

import pyarrow as pa
import pytest

from pipeline.core.errors import InputError
from pipeline.core.records import GeoTag, ImageRecord, Split, View
from pipeline.shards import record_table
from pipeline.shards.duplicates import find_duplicates
from pipeline.shards.pack import pack
from pipeline.shards.shard_set import open_shards
from pipeline.shards.verify import verify
from tests.shards.imagery import SOURCE, content, imagery, jpeg, packing, rejected


def test_pack_skips_duplicates_of_one_location(tmp_path: Path, ray_cluster: None) -> None:
    root, out = imagery(tmp_path / "root"), tmp_path / "out"
    copied = (root / "train/drone/0002/image-03.jpeg").read_bytes()
    (root / "train/drone/0002/zz copy.jpeg").write_bytes(copied)  # a double
    (root / "train/drone/0001/zz.jpeg").write_bytes(
        copied
    )  # the label differs: who is right is not ours to say
    (root / "test/gallery_drone/0002").mkdir(parents=True)
    (root / "test/gallery_drone/0002/image-03.jpeg").write_bytes(
        copied
    )  # University-1652's queries are in its gallery too
    manifest = pack(SOURCE, packing(root, out, max_bad_fraction=0.1))
    assert rejected(out) == [("zz copy.jpeg", "duplicate")]
    assert sum(shard.samples for shard in manifest.shards) == 17
    assert verify(open_shards(str(out))) == []
    again = pack(SOURCE, packing(root, tmp_path / "again", max_bad_fraction=0.1, workers=0))
    assert again.shards == manifest.shards


def test_find_duplicates_compares_positions() -> None:
    here, there = GeoTag(lat=1, lon=2), GeoTag(lat=3, lon=4)
    records = [
        ImageRecord(
            path=f"/{name}.png", split=Split.GALLERY, view=View.SATELLITE, location=name, geotag=tag
        )
        for name, tag in (("a", here), ("b", there), ("c", here))
    ]
    facts = {
        "source": "x",
        "sha256": "same",
        "width": 1,
        "height": 1,
        "view": "satellite",
        "split": "gallery",
    }
    rows = [
        record_table.row(record, "s", facts | {"key": record.key, "location": record.location}, 1)
        for record in records
    ]
    table = pa.Table.from_pylist(rows, record_table.SCHEMA)
    assert find_duplicates([table], frozenset()) == {"s": {records[2].key: "/a.png"}}


def test_extend_adds_tars_and_changes_nothing_old(tmp_path: Path, ray_cluster: None) -> None:
    root, out = imagery(tmp_path / "root"), tmp_path / "out"
    first = pack(SOURCE, packing(root, out))
    before = content(out)
    imagery(root, range(3, 5))
    jpeg(root / "train/drone/0000/new.jpeg", 999)
    (root / "train/drone/0000/copy.jpeg").write_bytes(
        (root / "train/drone/0000/image-00.jpeg").read_bytes()
    )
    second = pack(SOURCE, packing(root, out, extend=True))
    after = content(out)
    assert {name: after[name] for name in before if name.startswith(("train", "records"))} == {
        name: data for name, data in before.items() if name.startswith(("train", "records"))
    }
    assert second.shards[: len(first.shards)] == first.shards
    assert second.classes == ("0000", "0001", "0002", "0003", "0004")
    assert sum(shard.samples for shard in second.shards) == 15 + 10 + 1
    assert rejected(out) == [("copy.jpeg", "duplicate")]
    assert verify(open_shards(str(out))) == []
    third = pack(SOURCE, packing(root, out, extend=True))
    assert third.shards == second.shards


def test_extend_keeps_class_numbers(tmp_path: Path) -> None:
    out = tmp_path / "out"
    pack(SOURCE, packing(imagery(tmp_path / "later", range(5, 7)), out))
    manifest = pack(SOURCE, packing(imagery(tmp_path / "earlier", range(2)), out, extend=True))
    assert manifest.classes == ("0005", "0006", "0000", "0001")


def test_extend_refuses_another_image_of_a_known_name(tmp_path: Path) -> None:
    out, other = tmp_path / "out", tmp_path / "other"
    pack(SOURCE, packing(imagery(tmp_path / "root"), out))
    imagery(other)
    jpeg(other / "train/drone/0000/image-00.jpeg", 12345)
    manifest = pack(SOURCE, packing(other, out, extend=True, max_bad_fraction=0.1))
    assert rejected(out) == [("image-00.jpeg", "same name twice")]
    assert sum(shard.samples for shard in manifest.shards) == 15


def test_extend_needs_a_finished_set(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no finished set of shards; expected one to extend"):
        pack(SOURCE, packing(imagery(tmp_path / "root"), tmp_path / "out", extend=True))
