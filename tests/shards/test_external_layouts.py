"""Odd shards of others: names with dots, members apart, gzip, and a report of what is left out."""

import gzip
import io
import json
import tarfile
from pathlib import Path

import pytest

from pipeline.core.errors import InputError
from pipeline.shards.shard_set import open_or_scan
from tests.shards.test_external import TWO, picture


def tar_file(path: Path, members: dict[str, bytes], mode: str = "w") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with tarfile.open(path, mode) as tar:  # type: ignore[call-overload]
        for name, data in members.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            tar.addfile(member, io.BytesIO(data))


def read_all(folder: Path) -> dict[str, str]:
    """The location of each sample's key, without the split and view that begin it."""
    shards = open_or_scan(str(folder), *TWO)
    return {
        sample.key.removeprefix("gallery-satellite-"): sample.metadata["location"]
        for shard in shards.manifest.shards
        for sample in shards.samples(shard, verify=True)
    }


def label(location: object, **rest: object) -> bytes:
    return json.dumps({"location": location, "lat": 47, "lon": 8} | rest).encode()


@pytest.mark.parametrize(
    "names",
    [
        ("000.rgb.jpg", "000.json", "001.rgb.jpg", "001.json"),
        ("ortho_v1.2.jpg", "ortho_v1.2.json", "ortho_v1.3.jpg", "ortho_v1.3.json"),
        ("p48.1_11.5.jpg", "p48.1_11.5.json", "p48.2_11.5.jpg", "p48.2_11.5.json"),
        ("2024.01.05.rgb.JPG", "2024.01.05.json", "2024.01.06.rgb.JPG", "2024.01.06.json"),
        ("a.jpg", "b.jpg", "a.json", "b.json"),  # not side by side
        ("a.json", "b.json", "a.jpg", "b.jpg"),
    ],
)
def test_external_members_are_joined(
    names: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kinds = {"json": iter((label("x"), label("y"))), "jpg": iter((picture(1), picture(2)))}
    members = {name: next(kinds[name.lower().rpartition(".")[2]]) for name in names}
    tar_file(tmp_path / "0.tar", members)
    assert sorted(read_all(tmp_path).values()) == ["x", "y"]
    assert "left out" not in capsys.readouterr().err


def test_external_member_twice_in_a_sample_is_named(tmp_path: Path) -> None:
    tar_file(tmp_path / "0.tar", {"a.jpg": picture(1), "a.JPG": picture(2), "a.json": label("x")})
    with pytest.raises(
        InputError, match=r"0\.tar holds a second a\.JPG in one sample .*, expected"
    ):
        read_all(tmp_path)


def test_external_json_members_of_a_sample_are_joined(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`a.info.json` has the label, `a.jpg.json` the position; those of b contradict each other."""
    members = {
        "a.jpg": picture(1),
        "a.info.json": json.dumps({"label": "x", "note": 1}).encode(),
        "a.jpg.json": json.dumps([{"lat": 47.5, "lon": 8, "note": 2}]).encode(),
        "b.jpg": picture(2),
        "b.info.json": json.dumps({"label": "y", "lat": 1, "lon": 2}).encode(),
        "b.jpg.json": json.dumps({"label": "y", "lat": -1, "lon": 2}).encode(),
    }
    tar_file(tmp_path / "0.tar", members)
    shards = open_or_scan(str(tmp_path), *TWO)
    [first, second] = shards.samples(shards.manifest.shards[0])
    assert (first.metadata["location"], second.metadata["location"]) == ("x", "y")
    assert first.metadata["geotag"] == {"lat": 47.5, "lon": 8}
    assert second.metadata["geotag"] is None
    report = " ".join(capsys.readouterr().err.split())
    assert "1 samples have JSON members that contradict each other" in report
    assert "(b: lat)" in report
    assert "1 of 2 images: no position found" in report


@pytest.mark.parametrize("word", [b"NaN", b'"nan"', b'"NA"', b"null", b'""', b'" none "'])
def test_external_location_that_is_missing_is_none(
    word: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    members = {f"{name}.jpg": picture(shade) for shade, name in enumerate("ab")}
    members |= {f"{name}.json": b'{"label": %s}' % word for name in "ab"}
    tar_file(tmp_path / "0.tar", members)
    assert read_all(tmp_path) == {"a-a": "a", "b-b": "b"}
    assert "contradict" not in capsys.readouterr().err


def test_external_hidden_members_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As macOS writes its attributes of files: `._a.jpg` beside `a.jpg`."""
    members = {"./._a.jpg": b"x", "./a.jpg": picture(1), "./._a.json": b"x", "./a.json": label("x")}
    tar_file(tmp_path / "0.tar", members | {"__MACOSX/._a.jpg": b"x"})
    assert read_all(tmp_path) == {"x-a": "x"}
    report = " ".join(capsys.readouterr().err.split())
    assert "3 members of other kinds were left out (3 hidden)" in report


@pytest.mark.parametrize("name", ["0.tar.gz", "0.tgz", "0.tar"])
def test_external_tar_in_gzip_is_read(name: str, tmp_path: Path) -> None:
    tar_file(tmp_path / name, {"a.jpg": picture(1), "a.json": label("x")}, "w:gz")
    assert read_all(tmp_path) == {"x-a": "x"}
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="is cut off or damaged"):
        read_all(tmp_path)


def test_external_tar_and_gzip_of_one_name_are_both_read(tmp_path: Path) -> None:
    tar_file(tmp_path / "0.tar", {"a.jpg": picture(1), "a.json": label("x")})
    tar_file(tmp_path / "0.tar.gz", {"b.jpg": picture(2), "b.json": label("y")}, "w:gz")
    assert read_all(tmp_path) == {"x-a": "x", "y-b": "y"}


def test_external_archives_of_other_kinds_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tar_file(tmp_path / "0.tar", {"a.jpg": picture(1), "a.json": label("x")})
    archives = ("1.tar.bz2", "2.tar.xz", "3.zip", "4.tar.zst", "5.tar.part", "6.TAR", "x/7.tar")
    for name in archives:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    for name in ("0.tar.md5", "0.tar.idx", "0.json", "0.parquet", "0_stats.json"):
        (tmp_path / name).write_bytes(b"x")
    assert read_all(tmp_path) == {"x-a": "x"}
    report = " ".join(capsys.readouterr().err.split())
    assert f"{len(archives)} archives were left out" in report
    assert "(1.tar.bz2, 2.tar.xz, 3.zip, ...)" in report


@pytest.mark.parametrize("name", ["0.tar.bz2", "0.zip", "train/0.tar"])
def test_external_folder_without_readable_tars_names_them(name: str, tmp_path: Path) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(
        InputError, match=rf"holds 1 archives that are not read here, {name} first, expected \.tar,"
    ):
        open_or_scan(str(tmp_path), *TWO)


def test_external_gzip_of_a_huge_file_is_refused(tmp_path: Path) -> None:
    """4 MB of gzip would fill 4 GB of memory."""
    member = tarfile.TarInfo("a.jpg")
    member.size = 1 << 29
    (tmp_path / "0.tar").write_bytes(gzip.compress(member.tobuf() + bytes(1 << 16)))
    with pytest.raises(InputError, match="a file of 536870912 bytes, more than any image has"):
        open_or_scan(str(tmp_path), *TWO)


def test_scan_tars_reports_losses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    members = {
        "a.jpg": picture(1),
        "a.nir.jpg": picture(2),
        "a.json": json.dumps({"caption": "c", "label": 1}).encode(),
        "a.txt": b"caption",
        "lost.json": label("z"),
        "b.heic": b"no decoder",
        "b.cls": b"1",
    }
    tar_file(tmp_path / "0.tar", members)
    tar_file(tmp_path / "query-drone-0.tar", {"q.jpg": picture(3)})
    assert len(read_all(tmp_path)) == 1
    output = " ".join(capsys.readouterr().err.split())
    for sentence in (
        "1 of 1 images: no position found in their JSON (its fields are caption, label)",
        "1 further images of a sample were left out (a.nir.jpg)",
        "2 samples have no image and were left out (b, lost)",
        "1 tars whose names state another split or view were left out (query-drone-0.tar)",
        "2 members of other kinds were left out (1 .txt, 1 .heic)",
    ):
        assert sentence in output
