"""Files appear complete or not at all, on a disk and on any storage that fsspec knows."""

from pathlib import Path

import fsspec
import pytest

from pipeline.core import storage
from pipeline.core.errors import InputError


@pytest.fixture(params=["disk", "file uri", "memory"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "memory":
        fsspec.filesystem("memory").rm("/", recursive=True)
        return "memory://bucket/things"
    return str(tmp_path) if request.param == "disk" else tmp_path.as_uri()


def test_written_json_is_read_back_and_listed(folder: str) -> None:
    path = storage.join(folder, "deep", "a.json")
    assert not storage.exists(path)
    storage.write_json(path, {"é": [1, 2]})
    assert storage.exists(path)
    assert storage.read_json(path) == {"é": [1, 2]}
    assert storage.list_names(storage.join(folder, "deep")) == ["a.json"]
    assert list(storage.walk(folder)) == ["deep/a.json"]
    assert storage.is_folder(folder)


def test_failed_write_leaves_the_old_file(folder: str) -> None:
    path = storage.join(folder, "a.bin")
    storage.write_bytes(path, b"good")

    def half() -> None:
        with storage.atomic_write(path) as stream:
            stream.write(b"ba")
            raise RuntimeError("half way")

    with pytest.raises(RuntimeError, match="half way"):
        half()
    assert storage.read_bytes(path) == b"good"
    assert storage.list_names(folder) == ["a.bin"]


def test_absent_folder_has_no_names(tmp_path: Path) -> None:
    assert storage.list_names(str(tmp_path / "nowhere")) == []


def test_beside_names_a_neighbour(
    folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert storage.beside(f"{folder}/table/", ".json") == f"{folder}/table.json"
    assert storage.beside("memory://table", ".json") == "memory://table.json"
    monkeypatch.chdir(tmp_path)
    assert storage.beside(".", ".json") == f"{tmp_path}.json"


@pytest.mark.parametrize("root", ["/", "memory://", "file:///"])
def test_beside_a_root_is_nowhere(root: str) -> None:
    with pytest.raises(InputError, match="is the root of its storage, expected a folder in it"):
        storage.beside(root, ".json")


def test_absolute_changes_paths_and_not_uris(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert storage.absolute("a/b") == str(tmp_path / "a" / "b")
    assert storage.absolute("s3://bucket/a") == "s3://bucket/a"


def test_remove_temporaries_leaves_other_files(tmp_path: Path) -> None:
    for name in (
        ".a.parquet.0123abcd",
        ".b.parquet.0123abcd",
        ".a.parquet",
        "a.parquet",
        ".a.parquet.0123abcx",
    ):
        (tmp_path / name).touch()
    storage.remove_temporaries(str(tmp_path), ["a.parquet"])
    left = sorted(path.name for path in tmp_path.iterdir())
    assert left == [".a.parquet", ".a.parquet.0123abcx", ".b.parquet.0123abcd", "a.parquet"]
    storage.remove_temporaries(str(tmp_path / "nowhere"), ["a.parquet"])
