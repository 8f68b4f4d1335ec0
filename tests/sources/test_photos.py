"""Photos off a card: what becomes a record, where it is said to lie, and what is refused."""

import math
import os
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, TiffImagePlugin

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import ImageRecord, Rejection, Scanned, SkippedFile, Split, View
from pipeline.images.decode import decode
from pipeline.sources import name_of, source_class
from pipeline.sources.base import scan_images
from pipeline.sources.maps.georeference import ELLIPSOID
from pipeline.sources.photos import HEAD_BYTES, Photos, aim_point

HERE = {1: "S", 2: (33.0, 30.0, 0.0), 3: "W", 4: (70.0, 45.0, 0.0)}
"33.5 south, 70.75 west"
FLOWN = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    b'<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:RelativeAltitude="+100.00" '
    b'drone-dji:GimbalYawDegree="+90.00" drone-dji:GimbalPitchDegree="-45.00"/></rdf:RDF></x:xmpmeta>'
)


def photo(path: Path, gps: dict[int, Any] | None = None, **options: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif.get_ifd(0x8825).update(gps or {})
    exif.get_ifd(0x8769).update({0x9003: "2024:05:01 12:34:56"})
    kind = {".png": "PNG", ".webp": "WEBP", ".tif": "TIFF"}.get(path.suffix.lower(), "JPEG")
    Image.new("RGB", (16, 12), "green").save(path, kind, exif=exif, **options)


def scan(root: Path, **changes: Any) -> dict[str, Scanned]:
    found = {
        found.path.removeprefix(f"{root}/"): found for found in Photos(**changes).scan(str(root))
    }
    assert list(found) == sorted(found), "an order of names alone"
    return found


def records(root: Path, **changes: Any) -> dict[str, ImageRecord]:
    found = scan(root, **changes)
    assert all(isinstance(record, ImageRecord) for record in found.values()), found
    return found  # type: ignore[return-value]


def test_a_photo_becomes_a_query_from_a_drone_with_the_cameras_geotag(tmp_path: Path) -> None:
    photo(tmp_path / "flight 1/DJI_0001.JPG", HERE, xmp=FLOWN)
    [record] = records(tmp_path).values()
    assert (record.view, record.split, record.location) == (View.DRONE, Split.QUERY, "flight 1")
    assert record.taken_at == "2024-05-01T12:34:56"
    assert record.bytes == (tmp_path / "flight 1/DJI_0001.JPG").stat().st_size
    tag = record.geotag
    assert tag is not None
    assert (tag.lat, tag.lon, tag.altitude_m, tag.heading_deg, tag.pitch_deg) == (
        -33.5,
        -70.75,
        100,
        90,
        -45,
    )
    assert name_of(Photos()) == "photos"
    assert source_class("photos") is Photos


def test_photos_are_found_at_any_depth_with_any_name(tmp_path: Path) -> None:
    for name in (
        "a/b/c/1.jpeg",
        "a/b-c/1.jpg",
        "a-b/c/1.jpg",
        "Überflug №2/фото 1.JPG",
        "top.jpg",
        "a/2.PNG",
        ".hidden/3.jpg",
    ):
        photo(tmp_path / name, HERE)
    found = records(tmp_path)
    assert {path: record.location for path, record in found.items()} == {
        "a/b/c/1.jpeg": "a/b/c",
        "a/b-c/1.jpg": "a/b-c",
        "a-b/c/1.jpg": "a-b/c",
        "a/2.PNG": "a",
        "top.jpg": "top.jpg",
        "Überflug №2/фото 1.JPG": "Überflug №2",
    }
    assert len({record.key for record in found.values()}) == len(found)
    assert all(
        set(record.key) <= set("abcdefghijklmnopqrstuvwxyz0123456789_-")
        for record in found.values()
    )
    single = records(tmp_path, location="file")
    assert single["a/b/c/1.jpeg"].location == "a/b/c/1"
    assert len({record.location for record in single.values()}) == len(single)


def test_settings_say_what_the_photos_are(tmp_path: Path) -> None:
    photo(tmp_path / "tile.jpg")
    [record] = records(tmp_path, view=View.SATELLITE, split=Split.GALLERY).values()
    assert record.key.startswith("gallery-satellite-")


def test_companions_are_skipped_and_undecoded_images_refused(tmp_path: Path) -> None:
    photo(tmp_path / "DJI_0001.JPG")
    companions = {
        "DJI_0001.DNG": "raw copy of a photo",
        "DJI_0001.MP4": "companion file .mp4",
        "DJI_0002.SRT": "companion file .srt",
        "flight.kml": "companion file .kml",
        "Thumbs.db": "companion file .db",
        "DJI_0003.insp": "companion file .insp",
        "README": "file that is no image by its name",
        "report of v1.final version": "file that is no image by its name",
    }
    refused = {
        "DJI_0002.DNG": "format not decoded (.dng)",
        "IMG_0001.HEIC": "format not decoded (.heic)",
    }
    for name in (*companions, *refused):
        (tmp_path / name).write_bytes(b"x")
    found = scan(tmp_path)
    skipped = {path: one.reason for path, one in found.items() if isinstance(one, SkippedFile)}
    assert skipped == companions
    rejected = {path: one.reason for path, one in found.items() if isinstance(one, Rejection)}
    assert rejected == refused
    heic = found["IMG_0001.HEIC"]
    assert isinstance(heic, Rejection)
    assert heic.found == "IMG_0001.HEIC: HEIC is not decoded; convert it to JPEG, PNG or TIFF"


def test_the_summary_counts_positions_and_reasons(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photo(tmp_path / "1.jpg", HERE)
    photo(tmp_path / "2.jpg")
    photo(tmp_path / "3.jpg", HERE | {2: (95.0, 0.0, 0.0)})
    for name in ("1.srt", "2.srt", "a.kml", "4.heic"):
        (tmp_path / name).write_bytes(b"x")
    found = list(scan_images(Photos(), str(tmp_path)))
    assert len(found) == 4, "skipped files are counted, and no images"
    assert capsys.readouterr().err == (
        f"{tmp_path}: 2 images found, 1 with a position; 3 passed over (companion file .srt: 2, "
        "companion file .kml: 1); 2 refused (unreadable tag: 1, format not decoded (.heic): 1)\n"
    )


def test_a_position_that_cannot_be_right_is_refused_and_a_missing_one_is_not(
    tmp_path: Path,
) -> None:
    photo(tmp_path / "good.jpg", HERE)
    photo(tmp_path / "none.jpg")
    photo(tmp_path / "nofix.jpg", {1: "N", 2: (0.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 0.0)})
    photo(tmp_path / "pole.jpg", HERE | {2: (95.0, 0.0, 0.0)})
    (tmp_path / "text.jpg").write_bytes(b"packing judges whether this is an image")
    (tmp_path / "empty.jpg").write_bytes(b"")
    found = scan(tmp_path)
    pole = found.pop("pole.jpg")
    assert isinstance(pole, Rejection)
    assert pole.reason == "unreadable tag"
    assert "-95.0" in pole.found
    tagged = [
        path for path, record in found.items() if isinstance(record, ImageRecord) and record.geotag
    ]
    assert tagged == ["good.jpg"]
    assert len(found) == 5
    required = scan(tmp_path, geotags="required")
    reasons = {
        path: found.reason for path, found in required.items() if isinstance(found, Rejection)
    }
    assert reasons == dict.fromkeys(
        ("empty.jpg", "nofix.jpg", "none.jpg", "text.jpg"), "no position"
    ) | {"pole.jpg": "unreadable tag"}
    assert all(record.geotag is None for record in records(tmp_path, geotags="ignored").values())


def test_an_altitude_above_the_sea_is_no_height_above_the_ground(tmp_path: Path) -> None:
    photo(tmp_path / "phone.jpg", HERE | {6: 812.0})
    tag = records(tmp_path)["phone.jpg"].geotag
    assert tag is not None
    assert tag.altitude_m is None


def test_links_are_followed_and_those_into_nothing_are_refused(tmp_path: Path) -> None:
    photo(tmp_path / "card/1.jpg", HERE)
    root = tmp_path / "root"
    root.mkdir()
    (root / "flight").symlink_to(tmp_path / "card")
    (root / "one.jpg").symlink_to(tmp_path / "card/1.jpg")
    (root / "loop").symlink_to(root)
    assert list(records(root)) == ["flight/1.jpg", "one.jpg"]
    photo(tmp_path / "card/2.jpg", HERE)
    os.chmod(tmp_path / "card/2.jpg", 0)
    if os.access(tmp_path / "card/2.jpg", os.R_OK):
        return  # root reads everything
    refused = scan(root)["flight/2.jpg"]
    assert isinstance(refused, Rejection)
    assert refused.reason == "unreadable file"


def test_a_file_that_cannot_be_read_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo(tmp_path / "1.jpg", HERE)

    def broken(path: str, size: int) -> bytes:
        raise OSError("the cable came off")

    monkeypatch.setattr(storage, "read_head", broken)
    refused = scan(tmp_path)["1.jpg"]
    assert refused == Rejection(
        path=f"{tmp_path}/1.jpg", reason="unreadable file", found="the cable came off"
    )


def test_a_missing_and_an_empty_folder_say_what_was_expected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no folder .*nowhere; expected a folder of photos"):
        list(Photos().scan(str(tmp_path / "nowhere")))
    with pytest.raises(InputError, match=r"no images below .*, but nothing at all"):
        list(Photos().scan(str(tmp_path)))
    (tmp_path / "1.DNG").write_bytes(b"")
    with pytest.raises(InputError, match=r"but 1 \.DNG; expected photos"):
        list(Photos().scan(str(tmp_path)))


def test_only_the_beginning_of_a_photo_is_read_unless_its_tags_lie_further_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[str] = []
    whole = storage.read_bytes

    def watched(path: str) -> bytes:
        read.append(Path(path).name)
        return whole(path)

    monkeypatch.setattr(storage, "read_bytes", watched)
    pixels = Image.fromarray(
        np.random.default_rng(0).integers(0, 255, (400, 400, 3), dtype=np.uint8)
    )
    exif = Image.Exif()
    exif.get_ifd(0x8825).update(HERE)
    pixels.save(tmp_path / "a.jpg", exif=exif)
    with (tmp_path / "a.jpg").open("ab") as jpeg:
        jpeg.write(bytes(2 * HEAD_BYTES))
    pixels.save(tmp_path / "b.webp", exif=exif, lossless=True)
    info = TiffImagePlugin.ImageFileDirectory_v2()
    info[0x8825] = HERE
    pixels.save(tmp_path / "c.tif", tiffinfo=info)
    assert all(path.stat().st_size > HEAD_BYTES for path in tmp_path.iterdir())
    found = records(tmp_path)
    assert sorted(read) == ["b.webp", "c.tif"]
    assert all(
        record.geotag is not None and record.geotag.lat == -33.5 for record in found.values()
    )


def test_photos_on_an_object_store_are_read_like_those_on_a_disk(tmp_path: Path) -> None:
    fsspec.filesystem("memory").rm("/", recursive=True)
    photo(tmp_path / "1.jpg", HERE)
    storage.write_bytes("memory://bucket/flight/1.jpg", (tmp_path / "1.jpg").read_bytes())
    [record] = Photos().scan("memory://bucket")
    assert isinstance(record, ImageRecord)
    assert (record.path, record.location) == ("memory://bucket/flight/1.jpg", "flight")
    assert record.geotag is not None
    assert storage.read_head("memory://bucket/flight/1.jpg", 2) == b"\xff\xd8"


def test_a_camera_held_upright_is_turned_by_decoding(tmp_path: Path) -> None:
    """Orientation 6: the top of the scene is the right side of the file, so that decoding turns it
    clockwise.
    """
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8825).update(HERE)
    image = Image.new("RGB", (32, 16), "blue")
    image.paste("red", (0, 0, 16, 16))  # left in the file: on top of the scene
    image.save(tmp_path / "upright.jpg", exif=exif, quality=95)
    [record] = records(tmp_path).values()
    assert record.geotag is not None
    upright = decode(Photos().read(record))
    assert upright.shape == (32, 16, 3)
    assert upright[4, 8, 0] > 200, "red on top"
    assert upright[28, 8, 2] > 200, "blue below"


def test_the_axis_of_a_camera_at_45_degrees_arrives_one_height_ahead(tmp_path: Path) -> None:
    """100 m east on the parallel of 33.5 south: 100 / (6 384 650 cos 33.5) radians = 0.0010762
    degrees, with the radius of curvature a / sqrt(1 - e^2 sin^2 33.5) [WGS84].
    """
    photo(tmp_path / "1.jpg", HERE, xmp=FLOWN)
    [record] = records(tmp_path, project=True).values()
    tag = record.geotag
    assert tag is not None
    assert tag.lat == pytest.approx(-33.5, abs=1e-7)
    assert tag.lon == pytest.approx(-70.75 + 0.0010762, abs=1e-7)
    assert (tag.altitude_m, tag.heading_deg, tag.pitch_deg) == (100, 90, -45)


@pytest.mark.parametrize(
    ("old", "new"),
    [(b'"-45.00"', b'"-19.00"'), (b'"+100.00"', b'"-3.00"'), (b"GimbalYaw", b"WindYaw")],
)
def test_what_is_not_known_or_too_shallow_is_not_projected(
    tmp_path: Path, old: bytes, new: bytes
) -> None:
    photo(tmp_path / "1.jpg", HERE, xmp=FLOWN.replace(old, new))
    [record] = records(tmp_path, project=True).values()
    assert record.geotag is not None
    assert (record.geotag.lat, record.geotag.lon) == (-33.5, -70.75)


MERIDIAN_M, EQUATOR_M = 110_574.276, 111_319.491
"""Metres of a degree of latitude and of longitude at the equator: pi / 180 times a (1 - e^2) and
times a, with a = 6 378 137 m and e^2 = 0.00669438 [WGS84]."""


@pytest.mark.parametrize(
    ("heading", "pitch", "north_m", "east_m"),
    [
        (0, -45, 100, 0),
        (90, -45, 0, 100),
        (180, -45, -100, 0),
        (270, -26.565051177, 0, -200),
        (77, -90, 0, 0),
    ],
)
def test_the_axis_meets_the_ground_at_height_over_tangent(
    heading: float, pitch: float, north_m: float, east_m: float
) -> None:
    lat, lon = aim_point(0.0, 10.0, 100.0, heading, pitch)
    expected = (north_m / MERIDIAN_M, 10 + east_m / EQUATOR_M)
    assert (lat, lon) == pytest.approx(expected, abs=1e-9)


@given(
    st.floats(-90, 90),
    st.floats(-180, 180),
    st.floats(0.1, 1e4),
    st.floats(0, 360),
    st.floats(-90, -20),
)
def test_the_axis_meets_the_ground_at_the_right_distance(
    lat: float, lon: float, height: float, heading: float, pitch: float
) -> None:
    aim_lat, aim_lon = aim_point(lat, lon, height, heading, pitch)
    assert abs(aim_lat) <= 90
    assert -180 <= aim_lon <= 180
    metres = ELLIPSOID.inv(lon, lat, aim_lon, aim_lat)[2]
    assert metres == pytest.approx(height / math.tan(math.radians(-pitch)), abs=1e-3)
