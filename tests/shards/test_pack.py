"""The stage that packs: it goes on where it stopped, adds to what is there, and leaves out what is
there twice.
"""

import hashlib
import io
import json
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from jobs import make_shards
from jobs.command_line.cli import expand
from jobs.stages.settings import MakeShardsSettings
from pipeline.core import storage
from pipeline.core.errors import Incomplete, InputError
from pipeline.core.records import GeoTag, ImageRecord, Rejection, Split, View, make_key
from pipeline.shards import pack_tars, record_table
from pipeline.shards.duplicates import find_duplicates
from pipeline.shards.manifest import read_manifest
from pipeline.shards.pack import pack
from pipeline.shards.pack_tars import TooManyRejected
from pipeline.shards.plan import ShardPlan, ShardSize, plan_shards
from pipeline.shards.record_table import Packed, read_part
from pipeline.shards.settings import PackingSettings
from pipeline.shards.shard_set import open_shards
from pipeline.shards.verify import verify
from pipeline.shards.writer import HashedWriter, add_file, open_tar, write_shard
from pipeline.sources.university1652 import University1652

SOURCE = University1652()


def jpeg(path: Path, seed: int, side: int = 16) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 255, (side, side, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path, "JPEG")


def imagery(root: Path, places: range = range(3)) -> Path:
    """Of each place a satellite image and four of the UAV."""
    for place in places:
        jpeg(root / f"train/satellite/{place:04d}/{place:04d}.jpg", 100 * place)
        for number in range(4):
            jpeg(
                root / f"train/drone/{place:04d}/image-{number:02d}.jpeg", 100 * place + 1 + number
            )
    return root


def said(root: Path | str, out: Path | str, **changes: object) -> PackingSettings:
    given = {"root": str(root), "out": str(out), "samples_per_shard": 5, "workers": 0}
    return PackingSettings(**(given | changes))  # type: ignore[arg-type]


def content(out: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(out)): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file()
    }


def rejected(out: Path) -> list[tuple[str, str]]:
    return [
        (Path(row["path"]).name, row["reason"])
        for row in pq.read_table(out / "rejected.parquet").to_pylist()
    ]


def test_tasks_and_one_process_write_the_same_bytes(tmp_path: Path, ray_cluster: None) -> None:
    root = imagery(tmp_path / "root")
    pack(SOURCE, said(root, tmp_path / "alone"))
    pack(SOURCE, said(root, tmp_path / "tasks", workers=2))
    assert content(tmp_path / "alone") == content(tmp_path / "tasks")


def test_what_was_packed_before_a_stop_is_not_packed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, out = imagery(tmp_path / "root"), tmp_path / "out"
    whole = pack(SOURCE, said(root, tmp_path / "whole"))
    written: list[str] = []

    def stop_at_the_third(plan: ShardPlan, *given: Any) -> Packed:
        if len(written) == 2:
            raise KeyboardInterrupt
        written.append(plan.name)
        return write_shard(plan, *given)

    with monkeypatch.context() as patch:
        patch.setattr(pack_tars, "write_shard", stop_at_the_third)
        with pytest.raises(KeyboardInterrupt):
            pack(SOURCE, said(root, out))
    with pytest.raises(InputError, match="not a finished set"):
        read_manifest(str(out))
    before = {name: (out / f"{name}.tar").stat().st_mtime_ns for name in written}
    assert pack(SOURCE, said(root, out)) == whole
    assert {name: (out / f"{name}.tar").stat().st_mtime_ns for name in written} == before
    assert content(out) == content(tmp_path / "whole")


def test_an_image_that_was_mended_is_packed_when_the_job_runs_again(tmp_path: Path) -> None:
    root, out = imagery(tmp_path / "root"), tmp_path / "out"
    bad = root / "train/drone/0001/image-02.jpeg"
    good = bad.read_bytes()
    bad.write_bytes(good[:100])
    with pytest.raises(
        TooManyRejected,
        match=r"1 of 15 images were refused, more than 1\.00%: (truncated|damaged) image",
    ):
        pack(SOURCE, said(root, out))
    assert [name for name, _ in rejected(out)] == ["image-02.jpeg"]
    bad.write_bytes(good)
    pack(SOURCE, said(root, out))
    assert rejected(out) == []
    pack(SOURCE, said(root, tmp_path / "whole"))
    assert content(out) == content(tmp_path / "whole")


def test_other_settings_leave_no_old_tars_behind(tmp_path: Path) -> None:
    root, out = imagery(tmp_path / "root"), tmp_path / "out"
    (root / "train/drone/0001/bad.jpeg").write_bytes(b"no image")
    (out / "notes.tar").parent.mkdir()
    (out / "notes.tar").write_bytes(b"mine")
    with pytest.raises(TooManyRejected):
        pack(SOURCE, said(root, out, samples_per_shard=1))
    pack(SOURCE, said(root, out, samples_per_shard=100, max_bad_fraction=0.5))
    kept = sorted(path.name for path in out.glob("*.tar"))
    assert kept == [
        "notes.tar",
        "train-drone-000000.tar",
        "train-satellite-000000.tar",
    ]


def test_a_tar_that_was_lost_is_made_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, out = imagery(tmp_path / "root"), tmp_path / "out"
    pack(SOURCE, said(root, out))
    before = content(out)
    (out / "train-drone-000001.tar").unlink()
    (out / "train-drone-000000.tar").write_bytes(b"short")
    pack(SOURCE, said(root, out))
    assert "2 shards are missing or damaged" in capsys.readouterr().err.replace("\n", " ")
    assert content(out) == before


def test_the_same_bytes_twice_in_one_location_are_packed_once(tmp_path: Path) -> None:
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
    manifest = pack(SOURCE, said(root, out, max_bad_fraction=0.1))
    assert rejected(out) == [("zz copy.jpeg", "duplicate")]
    assert sum(shard.samples for shard in manifest.shards) == 17
    assert verify(open_shards(str(out))) == []
    again = pack(SOURCE, said(root, tmp_path / "again", max_bad_fraction=0.1, workers=0))
    assert again.shards == manifest.shards


def test_images_of_two_places_are_not_duplicates_and_those_of_one_place_are() -> None:
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


def test_new_imagery_is_added_as_new_tars_and_nothing_old_changes(tmp_path: Path) -> None:
    root, out = imagery(tmp_path / "root"), tmp_path / "out"
    first = pack(SOURCE, said(root, out))
    before = content(out)
    imagery(root, range(3, 5))
    jpeg(root / "train/drone/0000/new.jpeg", 999)
    (root / "train/drone/0000/copy.jpeg").write_bytes(
        (root / "train/drone/0000/image-00.jpeg").read_bytes()
    )
    second = pack(SOURCE, said(root, out, extend=True))
    after = content(out)
    assert {name: after[name] for name in before if name.startswith(("train", "records"))} == {
        name: data for name, data in before.items() if name.startswith(("train", "records"))
    }
    assert second.shards[: len(first.shards)] == first.shards
    assert second.classes == ("0000", "0001", "0002", "0003", "0004")
    assert sum(shard.samples for shard in second.shards) == 15 + 10 + 1
    assert rejected(out) == [("copy.jpeg", "duplicate")]
    assert verify(open_shards(str(out))) == []
    third = pack(SOURCE, said(root, out, extend=True))
    assert third.shards == second.shards


def test_an_extension_keeps_the_numbers_of_the_classes(tmp_path: Path) -> None:
    out = tmp_path / "out"
    pack(SOURCE, said(imagery(tmp_path / "later", range(5, 7)), out))
    manifest = pack(SOURCE, said(imagery(tmp_path / "earlier", range(2)), out, extend=True))
    assert manifest.classes == ("0005", "0006", "0000", "0001")


def test_another_image_under_a_known_name_is_refused_when_extending(tmp_path: Path) -> None:
    out, other = tmp_path / "out", tmp_path / "other"
    pack(SOURCE, said(imagery(tmp_path / "root"), out))
    imagery(other)
    jpeg(other / "train/drone/0000/image-00.jpeg", 12345)
    manifest = pack(SOURCE, said(other, out, extend=True, max_bad_fraction=0.1))
    assert rejected(out) == [("image-00.jpeg", "same name twice")]
    assert sum(shard.samples for shard in manifest.shards) == 15


def test_only_a_finished_set_can_be_extended(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no finished set of shards; expected one to extend"):
        pack(SOURCE, said(imagery(tmp_path / "root"), tmp_path / "out", extend=True))


def test_verification_names_every_kind_of_damage(tmp_path: Path, ray_cluster: None) -> None:
    out = tmp_path / "out"
    manifest = pack(SOURCE, said(imagery(tmp_path / "root"), out))
    assert verify(open_shards(str(out))) == []
    names = [shard.name for shard in manifest.shards]
    flipped, cut, gone = (out / f"{name}.tar" for name in names[:3])
    data = bytearray(flipped.read_bytes())
    data[700] ^= 1  # within the first image
    flipped.write_bytes(data)
    cut.write_bytes(cut.read_bytes()[:5000])
    gone.unlink()
    (out / f"records/{names[3]}.parquet").write_bytes(b"PAR1 no")
    wrong = verify(open_shards(str(out)))
    text = "\n".join(wrong)
    for path, words in (
        (flipped, "has not the hash that its JSON says"), (flipped, "has not the hash that the manifest says"),
        (cut, "is cut off or damaged after"), (cut, "has 5000 bytes, the manifest says"), (gone, "is missing"),
        (out / f"records/{names[3]}.parquet", "cannot be read"),
    ):  # fmt: skip
        assert any(line.startswith(str(path)) and words in line for line in wrong), (
            f"{path.name}: {words}\n{text}"
        )


def test_the_record_table_is_exported_as_parquet_and_geojson(tmp_path: Path) -> None:
    root, out = imagery(tmp_path / "root"), tmp_path / "out"
    (root / "locations.csv").write_text("location,lat,lon\n0001,52.5,13.4\n")
    pack(SOURCE, said(root, out))
    assert open_shards(str(out)).export(str(tmp_path / "all.parquet")) == (15, 0)
    rows = pq.read_table(tmp_path / "all.parquet").to_pylist()
    assert len({row["key"] for row in rows}) == 15
    assert open_shards(str(out)).export(str(tmp_path / "all.geojson")) == (5, 10)
    places = json.loads((tmp_path / "all.geojson").read_text())
    assert places["type"] == "FeatureCollection"
    assert {tuple(feature["geometry"]["coordinates"]) for feature in places["features"]} == {
        (13.4, 52.5)
    }
    assert {feature["properties"]["location"] for feature in places["features"]} == {"0001"}
    with pytest.raises(InputError, match=r"ends in .parquet or .geojson"):
        open_shards(str(out)).export(str(tmp_path / "all.shp"))


def test_shards_go_to_any_storage(tmp_path: Path) -> None:
    root = imagery(tmp_path / "root")
    pack(SOURCE, said(root, tmp_path / "disk"))
    memory = fsspec.filesystem("memory")
    pack(SOURCE, said(root, "memory://packed/shards"))
    names = [name for name in content(tmp_path / "disk") if name.endswith(".tar")]
    assert {name: memory.cat_file(f"/packed/shards/{name}") for name in names} == {
        name: (tmp_path / "disk" / name).read_bytes() for name in names
    }


def test_imagery_comes_from_any_storage(tmp_path: Path) -> None:
    root = imagery(tmp_path / "root")
    fsspec.filesystem("memory").put(str(root), "/imagery", recursive=True)
    assert (
        pack(SOURCE, said(root, tmp_path / "a")).shards
        == pack(SOURCE, said("memory://imagery", tmp_path / "b")).shards
    )


def test_a_relative_root_is_found_from_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    imagery(tmp_path / "root")
    monkeypatch.chdir(tmp_path)
    manifest = pack(SOURCE, said("root", "out"))
    paths = read_part(str(tmp_path / "out"), manifest.shards[0].name, ["path"])["path"].to_pylist()
    assert all(path.startswith(f"{tmp_path}/root/") for path in paths)


def test_a_file_name_that_is_no_text_is_refused(tmp_path: Path) -> None:
    root = imagery(tmp_path / "root")
    os.link(
        root / "train/drone/0000/image-00.jpeg",
        os.fsencode(root) + b"/train/drone/0000/caf\xe9.jpeg",
    )
    pack(SOURCE, said(root, tmp_path / "out", max_bad_fraction=0.1))
    assert rejected(tmp_path / "out") == [("caf\\udce9.jpeg", "name is not UTF-8")]


def test_a_tar_ends_at_so_many_megabytes() -> None:
    records = [
        ImageRecord(
            path=f"/{number}.jpg", split=Split.TRAIN, view=View.DRONE, location="a", bytes=400_000
        )
        for number in range(10)
    ]
    plans, _ = plan_shards(records, ShardSize(megabytes_per_shard=1.0))
    assert [len(plan.records) for plan in plans] == [2, 2, 2, 2, 2]
    plans, _ = plan_shards(
        [replace(record, bytes=3_000_000) for record in records[:2]],
        ShardSize(megabytes_per_shard=1.0),
    )
    assert [len(plan.records) for plan in plans] == [1, 1]


NAMES = st.text(
    st.characters(exclude_categories=["Cs"], exclude_characters="/\0"), min_size=1, max_size=150
)


@given(st.lists(st.tuples(NAMES, NAMES), unique=True, max_size=20))
def test_any_names_give_unique_legal_keys(names: list[tuple[str, str]]) -> None:
    keys = [
        make_key(Split.TRAIN, View.DRONE, location, stem)
        for location, stem in names
        if "-" not in location
    ]
    assert len(set(keys)) == len(keys)
    for key in keys:
        assert len(key) <= 90
        assert set(key) <= set("abcdefghijklmnopqrstuvwxyz0123456789_-")


DEGREES = st.floats(-90, 90)


@st.composite
def tags(draw: st.DrawFn) -> GeoTag | None:
    if draw(st.booleans()):
        return None
    known = {name: draw(st.none() | DEGREES) for name in ("altitude_m", "heading_deg", "pitch_deg")}
    corners = draw(st.none() | st.tuples(*[st.tuples(DEGREES, DEGREES)] * 4))
    return GeoTag(lat=draw(DEGREES), lon=draw(DEGREES), footprint=corners, **known)


def recorded(facts: dict[str, Any], row: dict[str, Any]) -> ImageRecord:
    """A record from the JSON in the tar and, for the file's path and size, the record table."""
    tag = facts["geotag"]
    if tag is not None:
        corners = tag.pop("footprint")
        assert (row["lat"], row["lon"], row["footprint"]) == (tag["lat"], tag["lon"], corners)
        tag = GeoTag(**tag, footprint=corners and tuple(map(tuple, corners)))
    kind = {
        "split": Split(facts["split"]),
        "view": View(facts["view"]),
        "location": facts["location"],
    }
    return ImageRecord(path=row["path"], geotag=tag, bytes=row["bytes"], **kind)


@settings(max_examples=25)
@given(
    st.lists(
        st.tuples(st.sampled_from(Split), st.sampled_from(View), NAMES, tags()),
        min_size=1,
        max_size=8,
    ),
    st.integers(1, 4),
)
def test_records_to_shards_to_records_is_the_identity(
    tmp_path_factory: pytest.TempPathFactory,
    kinds: list[tuple[Split, View, str, GeoTag | None]],
    size: int,
) -> None:
    folder = tmp_path_factory.mktemp("identity")
    records = []
    for number, (split, view, location, tag) in enumerate(kinds):
        path = folder / f"{number}.png"
        Image.fromarray(np.full((9, 8 + number, 3), number, np.uint8)).save(path)
        records.append(
            ImageRecord(
                path=str(path),
                split=split,
                view=view,
                location=location,
                geotag=tag,
                bytes=path.stat().st_size,
            )
        )

    class Given(University1652):
        def scan(self, root: str) -> Iterator[ImageRecord | Rejection]:
            return iter(records)

    manifest = pack(Given(), said(folder, folder / "out", samples_per_shard=size))
    back = []
    for shard in manifest.shards:
        rows = read_part(str(folder / "out"), shard.name).to_pylist()
        for sample, row in zip(open_shards(str(folder / "out")).samples(shard), rows, strict=True):
            assert (row["key"], row["location"]) == (sample.key, sample.metadata["location"])
            assert sample.data == storage.read_bytes(row["path"])
            back.append(recorded(sample.metadata, row))
    assert sorted(back, key=lambda record: record.path) == sorted(
        records, key=lambda record: record.path
    )


def test_tar_bytes_stay_the_same() -> None:
    """The hash was recorded from the tars that this project's own writer made, before tarfile."""
    stream = io.BytesIO()
    hashed = HashedWriter(stream)
    with open_tar(hashed) as tar:
        add_file(tar, "train-drone-a-0.jpg", bytes(range(256)) * 3)
        add_file(tar, "train-drone-a-0.json", b'{"key": "train-drone-a-0"}')
        add_file(tar, "empty.png", b"")
        add_file(tar, "x" * 96 + ".jpg", bytes(1024))
    recorded = "54f37695d31a8ba63295c3e6897535e8f8ebf80561537144890f7f223f174089"
    assert hashlib.sha256(stream.getvalue()).hexdigest() == recorded
    assert (hashed.digest.hexdigest(), hashed.tell()) == (recorded, 10240)


def test_the_job_checks_and_exports_a_finished_set(
    tmp_path: Path, ray_cluster: None, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    manifest = pack(SOURCE, said(imagery(tmp_path / "root"), out))
    make_shards.main(MakeShardsSettings(out=str(out), verify=True))
    geojson = str(tmp_path / "all.geojson")
    make_shards.main(MakeShardsSettings(out=str(out), export=geojson))
    told = capsys.readouterr().err
    assert f"all {len(manifest.shards)} shards are what was packed" in told
    assert "0 images, 15 without a position left out" in told
    (out / f"{manifest.shards[0].name}.tar").unlink()
    with pytest.raises(
        Incomplete, match="is damaged in 1 places; run the command that packed it again"
    ):
        make_shards.main(MakeShardsSettings(out=str(out), verify=True))


def test_a_source_is_named_by_a_flag_in_either_form() -> None:
    for words in (
        ["--root", "x", "--source", "xyz", "--zoom", "3"],
        ["--root", "x", "--source=xyz", "--zoom", "3"],
    ):
        found = expand(make_shards.main, words, make_shards.SOURCE, None)
        assert found == ("xyz", ["--root", "x", "--zoom", "3"])
    assert expand(make_shards.main, ["--help"], make_shards.SOURCE, None) == (None, ["--help"])
