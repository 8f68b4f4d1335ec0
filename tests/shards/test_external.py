"""Shards that others made: read in our words, embedded as they are, and refused where they do not
say enough.
"""

import hashlib
import io
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import webdataset
from PIL import Image

from pipeline.batches.settings import StreamConfig
from pipeline.batches.training import TrainingStream
from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.features.embed import embed_gallery
from pipeline.features.embed_worker import Encoder, EncoderSpec
from pipeline.features.encoding import EncodingConfig
from pipeline.features.settings import EmbeddingSettings
from pipeline.features.table import open_table
from pipeline.shards.external import external_metadata
from pipeline.shards.manifest import read_manifest
from pipeline.shards.samples import read_samples
from pipeline.shards.shard_set import open_or_scan, open_shards

TWO = (Split.GALLERY, View.SATELLITE)

ENCODING = EncodingConfig(mirror=False, resizer="torch", precision="float32")


def picture(shade: int) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (32, 32), (shade, 90, 200)).save(buffer, "JPEG")
    return buffer.getvalue()


def write(path: Path, samples: Iterator[dict[str, object]]) -> None:
    with webdataset.TarWriter(str(path)) as tar:
        for sample in samples:
            tar.write(sample)


@pytest.fixture
def foreign(tmp_path: Path) -> str:
    """Two tars of five images each, written by webdataset: JSON beside them in one, labels in the
    other.
    """
    folder = tmp_path / "foreign"
    folder.mkdir()
    write(
        folder / "part-00.tar",
        (
            {
                "__key__": f"{n:05d}",
                "jpg": picture(n),
                "json": {"label": n // 2, "lat": 48.0 + n, "lon": 11},
                "txt": "hi",
            }
            for n in range(5)
        ),
    )
    write(
        folder / "part-01.tar",
        (
            {"__key__": f"Town Hall/{n}", "jpg": picture(100 + n), "cls": 7 + n, "pyd": {"no": 1}}
            for n in range(5)
        ),
    )
    return str(folder)


def test_scan_tars_describes_each_tar(foreign: str) -> None:
    manifest = open_or_scan(foreign, *TWO).manifest
    assert [(shard.name, shard.samples) for shard in manifest.shards] == [
        ("part-00", 5),
        ("part-01", 5),
    ]
    for shard in manifest.shards:
        data = (Path(foreign) / f"{shard.name}.tar").read_bytes()
        assert (shard.bytes, shard.sha256) == (len(data), hashlib.sha256(data).hexdigest())
        assert (shard.split, shard.view) == (Split.GALLERY, View.SATELLITE)
    assert open_or_scan(Path(foreign).as_uri(), *TWO).manifest.shards == manifest.shards


def test_external_samples_have_keys_labels_and_positions(foreign: str) -> None:
    first, second = (
        list(read_samples(f"{foreign}/{name}.tar", TWO)) for name in ("part-00", "part-01")
    )
    assert [sample.key for sample in first] == [
        f"gallery-satellite-{n // 2}-{n:05d}" for n in range(5)
    ]
    assert [sample.metadata["location"] for sample in first] == ["0", "0", "1", "1", "2"]
    assert first[3].metadata["geotag"] == {"lat": 51.0, "lon": 11.0}
    assert first[3].data == picture(3)
    assert [sample.metadata["location"] for sample in second] == [str(7 + n) for n in range(5)]
    assert len({sample.key for sample in first + second}) == 10
    assert all(
        set(sample.key) <= set("abcdefghijklmnopqrstuvwxyz0123456789_-")
        for sample in first + second
    )
    assert all(
        sample.key == sample.metadata["key"] and sample.metadata["view"] == "satellite"
        for sample in first + second
    )


@pytest.mark.parametrize(
    ("key", "stated", "label", "location"),
    [
        ("a/b/0", {"location": "here", "id": 3}, b"4", "here"),
        ("a/b/0", {"class": 0}, b"4", "0"),
        ("a/b/0", {"label": [1, 2]}, b"4\n", "4"),
        ("a/b/0", {}, None, "b"),
        ("0", {}, None, "0"),
        ("0", {"location": 12.0}, None, "12"),
        ("0", {"location": "12.0"}, None, "12"),
        ("0", {"location": 12.5}, None, "12.5"),
        ("0", {"location": {"lat": 1}, "id": 7}, None, "7"),
        ("0", {}, b"12.0\n", "12"),
    ],
)
def test_external_location_prefers_the_most_reliable_field(
    key: str, stated: dict[str, object], label: bytes, location: str
) -> None:
    assert external_metadata(key, stated, label, *TWO)["location"] == location


@pytest.mark.parametrize(
    ("stated", "geotag"),
    [
        ({"latitude": 1, "lng": -2.5}, {"lat": 1.0, "lon": -2.5}),
        ({"geotag": {"lat": 3, "lon": 4}}, {"lat": 3.0, "lon": 4.0}),
        ({"lat": "3", "lon": "4"}, {"lat": 3.0, "lon": 4.0}),
        ({"Latitude": " 47,5 ", "Longitude": "8"}, {"lat": 47.5, "lon": 8.0}),
        ({"gps": {"lat": 3, "lng": "4"}}, {"lat": 3.0, "lon": 4.0}),
        ({"location": {"coordinates": {"lat": 3, "lon": 4}}}, {"lat": 3.0, "lon": 4.0}),
        ({"geometry": {"type": "Point", "coordinates": [8, 47]}}, {"lat": 47.0, "lon": 8.0}),
        ({"coordinates": [47, 8]}, None),
        ({"lat": "nan", "lon": "4"}, None),
        ({"lat": "", "lon": None}, None),
        ({"lat": True, "lon": 4}, None),
        ({"lat": 300.0, "lon": 4.0}, None),
        ({"lat": float("nan"), "lon": 4.0}, None),
        ({"lat": 3.0}, None),
    ],
)
def test_external_position_of_plain_numbers(
    stated: dict[str, object], geotag: dict[str, float] | None
) -> None:
    assert external_metadata("0", stated, None, *TWO)["geotag"] == geotag


def test_open_external_without_split_or_view_is_refused(foreign: str, tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"holds 2 tars and no manifest\.json: .* expected both --split and --view"
    ):
        open_or_scan(foreign, view=View.SATELLITE)
    with pytest.raises(InputError, match=r"part-00\.tar was not packed by jobs/make_shards\.py"):
        list(read_samples(f"{foreign}/part-00.tar"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="not a finished set of shards"):
        open_or_scan(str(tmp_path / "empty"), *TWO)
    with pytest.raises(InputError, match=r"holds 2 archives .*, foreign/part-00\.tar first, exp"):
        open_or_scan(str(tmp_path), *TWO)
    with pytest.raises(InputError, match=r"no manifest\.json"):
        TrainingStream(open_shards(foreign), StreamConfig())


def test_open_or_scan_reads_packed_shards_as_they_are(tiny_shards: str) -> None:
    assert (
        open_or_scan(tiny_shards).manifest
        == open_or_scan(tiny_shards, *TWO).manifest
        == read_manifest(tiny_shards)
    )
    name = read_manifest(tiny_shards).shards[0].name
    assert list(read_samples(f"{tiny_shards}/{name}.tar")) == list(
        read_samples(f"{tiny_shards}/{name}.tar", TWO)
    )


def test_scan_tars_refuses_a_repeated_key(foreign: str) -> None:
    write(
        Path(foreign) / "part-02.tar",
        ({"__key__": f"{n:05d}", "jpg": picture(n)} for n in range(4, 6)),
    )
    with pytest.raises(
        InputError, match=r"sample 00004 is in part-00\.tar and again in part-02\.tar"
    ):
        open_or_scan(foreign, *TWO)


def test_scan_tars_skips_tars_of_another_view(foreign: str) -> None:
    (Path(foreign) / "part-01.tar").rename(Path(foreign) / "query-drone-000000.tar")
    assert [shard.name for shard in open_or_scan(foreign, *TWO).manifest.shards] == ["part-00"]
    found = open_or_scan(foreign, Split.QUERY, View.DRONE).manifest.shards
    assert [shard.name for shard in found] == ["part-00", "query-drone-000000"]


def test_external_shards_are_embedded_and_resumed(foreign: str, tmp_path: Path) -> None:
    def factory(threads: int) -> Encoder:
        def encode(images_B3HW: np.ndarray) -> np.ndarray:
            mean_B3 = images_B3HW.mean((2, 3)).astype(np.float32) + 1
            unit: np.ndarray = mean_B3 / np.linalg.norm(mean_B3, axis=1, keepdims=True)
            return unit

        return encode

    network = EncoderSpec(fingerprint="f" * 64, encoding=ENCODING, image_size=16, factory=factory)
    out, (split, view) = str(tmp_path / "table"), TWO
    settings = EmbeddingSettings(shards=foreign, out=out, workers=0, split=split, view=view)
    assert embed_gallery(settings, network) == 10
    assert embed_gallery(settings, network) == 0
    table = open_table(out)
    assert table.counts == {(Split.GALLERY, View.SATELLITE): 10}
    assert table.labels().locations.tolist()[:3] == ["0", "0", "1"]
    assert table.labels().lats.tolist()[:2] == [48.0, 49.0]
    assert json.loads(json.dumps(table.parts)) == ["part-00.parquet", "part-01.parquet"]
