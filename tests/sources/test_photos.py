"""Photos off a card: records, positions, and files that are refused or skipped."""

import os
from pathlib import Path

import fsspec
import numpy as np
import pytest
from PIL import Image, TiffImagePlugin

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import ImageRecord, Rejection, SkippedFile, Split, View
from pipeline.images import optional_formats
from pipeline.images.decode import decode
from pipeline.sources import name_of, source_class
from pipeline.sources.base import scan_images
from pipeline.sources.photos import HEAD_BYTES, Photos
from tests.sources.photo_files import FLOWN, HERE, photo, records, scan


def test_photo_becomes_a_drone_query_with_geotag(tmp_path: Path) -> None:
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


def test_photos_view_and_split_come_from_settings(tmp_path: Path) -> None:
    photo(tmp_path / "tile.jpg")
    [record] = records(tmp_path, view=View.SATELLITE, split=Split.GALLERY).values()
    assert record.key.startswith("gallery-satellite-")


def test_photos_companions_skipped_and_undecoded_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(optional_formats, "find_spec", lambda module: None)
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
        "IMG_0002.avif": "format not decoded (.avif)",
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
    assert heic.found == (
        "IMG_0001.HEIC: HEIC is not decoded; convert it to JPEG, PNG or TIFF, or install the extra "
        "`heif`: pip install pvda[heif]"
    )


def test_scan_images_summary_counts_positions_and_reasons(
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


def test_photo_impossible_position_is_refused_missing_one_not(
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


def test_photo_altitude_above_sea_is_no_height(tmp_path: Path) -> None:
    photo(tmp_path / "phone.jpg", HERE | {6: 812.0})
    tag = records(tmp_path)["phone.jpg"].geotag
    assert tag is not None
    assert tag.altitude_m is None


def test_photos_links_are_followed(tmp_path: Path) -> None:
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


def test_photo_that_cannot_be_read_is_refused(
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


def test_photos_missing_and_empty_folder_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(optional_formats, "find_spec", lambda module: None)
    with pytest.raises(InputError, match=r"no folder .*nowhere; expected a folder of photos"):
        list(Photos().scan(str(tmp_path / "nowhere")))
    with pytest.raises(InputError, match=r"no images below .*, but nothing at all"):
        list(Photos().scan(str(tmp_path)))
    (tmp_path / "1.DNG").write_bytes(b"")
    with pytest.raises(
        InputError, match=r"but 1 \.DNG \(1\.DNG: DNG is not .*pvda\[raw\]\); expected photos"
    ):
        list(Photos().scan(str(tmp_path)))


def test_read_photo_reads_the_head_unless_tags_lie_beyond(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[str] = []
    whole = storage.read_bytes

    def watched(path: str) -> bytes:
        if Path(path).parent == tmp_path:  # not what a thread of another test reads
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


def test_photos_are_read_from_an_object_store(tmp_path: Path) -> None:
    fsspec.filesystem("memory").rm("/", recursive=True)
    photo(tmp_path / "1.jpg", HERE)
    storage.write_bytes("memory://bucket/flight/1.jpg", (tmp_path / "1.jpg").read_bytes())
    [record] = Photos().scan("memory://bucket")
    assert isinstance(record, ImageRecord)
    assert (record.path, record.location) == ("memory://bucket/flight/1.jpg", "flight")
    assert record.geotag is not None
    assert storage.read_head("memory://bucket/flight/1.jpg", 2) == b"\xff\xd8"


def test_photo_orientation_is_applied_by_decoding(tmp_path: Path) -> None:
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


def test_unreadable_tags_are_counted_with_an_example(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photo(tmp_path / "a.jpg", HERE, xmp=FLOWN[:-30])
    photo(tmp_path / "b.jpg", HERE, xmp=FLOWN)
    [first, second] = scan_images(Photos(), str(tmp_path))
    assert isinstance(first, ImageRecord)
    assert isinstance(second, ImageRecord)
    assert first.geotag is not None
    assert (first.geotag.lat, first.geotag.altitude_m) == (-33.5, None)
    assert not second.unreadable_tags
    summary = capsys.readouterr().err
    assert "; 1 with tags that could not be read (such as " in summary
    assert f"{tmp_path}/a.jpg: XMP that is not XML" in summary
