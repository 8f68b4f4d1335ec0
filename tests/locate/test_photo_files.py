"""Photos named on the command line, and their times."""

import io
from pathlib import Path

import pytest
from PIL import Image

from pipeline.core.errors import InputError
from pipeline.images.camera_tags import CameraTags
from pipeline.locate.photo_files import (
    find_photos,
    parent_folder,
    parse_time,
    read_photo_tags,
    read_times,
)


def test_find_photos_below_folders_each_once(tmp_path: Path) -> None:
    for name in ("b.jpg", "a.jpg", "notes.txt", "deep/c.PNG"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = find_photos([f"{tmp_path}/b.jpg", str(tmp_path)])
    assert [path.removeprefix(f"{tmp_path}/") for path in found] == ["b.jpg", "a.jpg", "deep/c.PNG"]
    assert parent_folder(found[2]) == f"{tmp_path}/deep"
    assert parent_folder("a.jpg") == "."


def test_find_photos_counts_files_passed_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Undecoded formats stay in the list; a raw file is passed over only beside its own photo."""
    for name in ("a.jpg", "A.DNG", "b.HEIC", "c.DNG", "track.kml", "Thumbs.db"):
        (tmp_path / name).write_bytes(b"x")
    found = find_photos([str(tmp_path)])
    assert [Path(path).name for path in found] == ["a.jpg", "b.HEIC", "c.DNG"]
    printed = " ".join(capsys.readouterr().err.split())
    assert "3 files passed over (" in printed
    assert "not an image by its name: 2" in printed
    assert "raw copy of a photo: 1" in printed


def test_find_photos_missing_path_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no photo or folder at .*gone.jpg"):
        find_photos([str(tmp_path / "gone.jpg")])
    with pytest.raises(InputError, match="no images below"):
        find_photos([str(tmp_path)])
    with pytest.raises(InputError, match="no photo was named"):
        find_photos([])


def test_read_photo_tags_from_exif() -> None:
    stream, exif = io.BytesIO(), Image.Exif()
    exif.get_ifd(0x8769)[0x9003] = "2026:11:24 09:30:05"
    Image.new("RGB", (16, 16)).save(stream, "JPEG", exif=exif)
    assert read_photo_tags(stream.getvalue()).taken_at == "2026-11-24T09:30:05"
    assert read_photo_tags(b"no image") == CameraTags()


def test_parse_time_seconds_and_iso_8601() -> None:
    assert parse_time("12.5") == 12.5
    assert parse_time("2026-11-24T09:30:05.5") - parse_time("2026-11-24T09:30:00") == 5.5
    assert parse_time("2026-11-24T10:30:00+01:00") == parse_time("2026-11-24T09:30:00")
    with pytest.raises(ValueError, match="nan"):
        parse_time("nan")


def test_read_times_by_path_or_name(tmp_path: Path) -> None:
    path = tmp_path / "times.csv"
    path.write_text("photo,time\nb.jpg,20\n/x/a.jpg,10\n")
    assert read_times(str(path), ["/x/a.jpg", "/x/b.jpg"]) == {"/x/a.jpg": "10", "/x/b.jpg": "20"}


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (None, "no table at"),
        ("name,when\na.jpg,1\n", "no rows with the columns photo, time"),
        ("photo,time\nb.jpg,1\n", "has no row for /x/a.jpg"),
        ("photo,time\na.jpg,noon\n", "has the time 'noon' for /x/a.jpg"),
    ],
)
def test_read_times_invalid_table_is_refused(
    tmp_path: Path, text: str | None, sentence: str
) -> None:
    path = tmp_path / "times.csv"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=sentence):
        read_times(str(path), ["/x/a.jpg"])
