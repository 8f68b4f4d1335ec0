"""Records, tars and the record table: round trips, verification, and export."""

import hashlib
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from jobs import make_shards
from jobs.stages.settings import MakeShardsSettings
from pipeline.core import parquet, storage
from pipeline.core.errors import Incomplete, InputError
from pipeline.core.integrity import FileChecksum, HashingStream
from pipeline.core.records import GeoTag, ImageRecord, Rejection, Split, View, make_key
from pipeline.shards.pack import pack
from pipeline.shards.record_table import read_part
from pipeline.shards.shard_set import open_shards
from pipeline.shards.verify import verify
from pipeline.shards.writer import add_file, open_tar
from pipeline.sources.university1652 import University1652
from tests.shards.imagery import SOURCE, imagery, packing


def test_verify_names_every_kind_of_damage(tmp_path: Path, ray_cluster: None) -> None:
    out = tmp_path / "out"
    manifest = pack(SOURCE, packing(imagery(tmp_path / "root"), out))
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
        (flipped, "has not the hash that its JSON says"),
        (flipped, "has not the hash that the manifest says"),
        (cut, "is cut off or damaged after"),
        (cut, "has 5000 bytes, the manifest says"),
        (gone, "is missing"),
        (out / f"records/{names[3]}.parquet", "cannot be read"),
    ):
        assert any(line.startswith(str(path)) and words in line for line in wrong), (
            f"{path.name}: {words}\n{text}"
        )


def test_export_as_parquet_and_geojson(tmp_path: Path) -> None:
    root, out = imagery(tmp_path / "root"), tmp_path / "out"
    (root / "locations.csv").write_text("location,lat,lon\n0001,52.5,13.4\n")
    pack(SOURCE, packing(root, out))
    assert open_shards(str(out)).export(str(tmp_path / "all.parquet")) == (15, 0)
    rows = pq.read_table(tmp_path / "all.parquet").to_pylist()
    assert len({row["key"] for row in rows}) == 15
    assert open_shards(str(out)).export(str(tmp_path / "all.geojson")) == (5, 10)
    points = json.loads((tmp_path / "all.geojson").read_text())
    assert points["type"] == "FeatureCollection"
    assert {tuple(feature["geometry"]["coordinates"]) for feature in points["features"]} == {
        (13.4, 52.5)
    }
    assert {feature["properties"]["location"] for feature in points["features"]} == {"0001"}
    with pytest.raises(InputError, match=r"ends in .parquet or .geojson"):
        open_shards(str(out)).export(str(tmp_path / "all.shp"))


def test_records_of_before_levels_are_read(tmp_path: Path) -> None:
    out = tmp_path / "out"
    [shard, *_] = pack(SOURCE, packing(imagery(tmp_path / "root"), out)).shards
    part = str(out / f"records/{shard.name}.parquet")
    rows = read_part(str(out), shard.name)
    parquet.write_table(part, parquet.read_table(part).drop_columns(["level", "roll_deg"]))
    assert read_part(str(out), shard.name) == rows
    assert read_part(str(out), shard.name, ["level", "key"]).to_pylist()[0]["level"] is None
    assert open_shards(str(out)).export(str(tmp_path / "all.parquet")) == (15, 0)


NAMES = st.text(
    st.characters(exclude_categories=["Cs"], exclude_characters="/\0"), min_size=1, max_size=150
)


@given(st.lists(st.tuples(NAMES, NAMES), unique=True, max_size=20))
def test_make_key_is_unique_and_legal(names: list[tuple[str, str]]) -> None:
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
    names = ("altitude_m", "heading_deg", "pitch_deg", "roll_deg", "focal_35mm")
    known = {name: draw(st.none() | DEGREES) for name in names}
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
        "level": facts.get("level", ""),
    }
    assert facts.get("level") == row["level"]
    assert row["focal_35mm"] == (None if tag is None else tag.focal_35mm)
    return ImageRecord(path=row["path"], geotag=tag, bytes=row["bytes"], **kind)


@pytest.mark.slow
@settings(max_examples=25)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(Split),
            st.sampled_from(View),
            NAMES,
            tags(),
            st.sampled_from(["", "60m"]),
        ),
        min_size=1,
        max_size=8,
    ),
    st.integers(1, 4),
)
def test_records_round_trip_through_shards(
    tmp_path_factory: pytest.TempPathFactory,
    kinds: list[tuple[Split, View, str, GeoTag | None, str]],
    size: int,
) -> None:
    folder = tmp_path_factory.mktemp("identity")
    records = []
    for number, (split, view, location, tag, level) in enumerate(kinds):
        path = folder / f"{number}.png"
        Image.fromarray(np.full((9, 8 + number, 3), number, np.uint8)).save(path)
        records.append(
            ImageRecord(
                path=str(path),
                split=split,
                view=view,
                location=location,
                geotag=tag,
                level=level,
                bytes=path.stat().st_size,
            )
        )

    class Given(University1652):
        def scan(self, root: str) -> Iterator[ImageRecord | Rejection]:
            return iter(records)

    manifest = pack(Given(), packing(folder, folder / "out", samples_per_shard=size))
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


def test_tar_bytes_are_those_of_the_recorded_hash() -> None:
    """The hash was recorded from the tars that this project's own writer made, before tarfile."""
    stream = io.BytesIO()
    hashed = HashingStream(stream)
    with open_tar(hashed) as tar:
        add_file(tar, "train-drone-a-0.jpg", bytes(range(256)) * 3)
        add_file(tar, "train-drone-a-0.json", b'{"key": "train-drone-a-0"}')
        add_file(tar, "empty.png", b"")
        add_file(tar, "x" * 96 + ".jpg", bytes(1024))
    recorded = "54f37695d31a8ba63295c3e6897535e8f8ebf80561537144890f7f223f174089"
    assert hashlib.sha256(stream.getvalue()).hexdigest() == recorded
    assert hashed.checksum == FileChecksum(bytes=10240, sha256=recorded)


def test_job_verifies_and_exports_a_finished_set(
    tmp_path: Path, ray_cluster: None, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    manifest = pack(SOURCE, packing(imagery(tmp_path / "root"), out))
    make_shards.main(MakeShardsSettings(out=str(out), verify=True))
    geojson = str(tmp_path / "all.geojson")
    make_shards.main(MakeShardsSettings(out=str(out), export=geojson))
    output = capsys.readouterr().err
    assert f"all {len(manifest.shards)} shards are what was packed" in output
    assert "0 images, 15 without a position left out" in output
    (out / f"{manifest.shards[0].name}.tar").unlink()
    with pytest.raises(
        Incomplete, match="is damaged in 1 places; run the command that packed it again"
    ):
        make_shards.main(MakeShardsSettings(out=str(out), verify=True))
