"""The metadata of an index, and the checks of its files when it is opened."""

import json
import os
from pathlib import Path

import pytest

from pipeline.core import json_files, storage
from pipeline.core.errors import InputError
from pipeline.index.searcher import Index
from tests.index.index_tables import build, write_gallery

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> str:
    """1,000 satellite rows of the gallery in five parts and 40 UAV queries, of 32 dimensions."""
    return str(write_gallery(tmp_path_factory.mktemp("table"), parts=5, dtype="float16"))


def test_index_metadata_describes_the_build(table: str, tmp_path: Path) -> None:
    index = build(table, tmp_path / "index", factory="IVF8,SQ8", target_recall=0.9)
    entries = json.loads((tmp_path / "index" / "index.json").read_text())
    assert entries["rows"] == 1000
    assert entries["training_sample"] == 1000
    assert entries["recall_at_10"] >= 0.9
    assert entries["recall_queries"] == 40
    assert entries["recall_queries_from"] == "rows of the table that are not indexed"
    assert entries["queries_per_second"] > 0
    assert entries["build_seconds"] > 0
    assert 40 < entries["bytes_per_vector"] < 80
    assert entries["parts"][0]["table_parts"]["gallery-satellite-000000.parquet"] == "shard 0"
    assert index.metadata.search_params.nprobe_or_ef < 8, "no more lists than it takes"


@pytest.mark.parametrize("name", ["index.faiss", "ids.arrow", "ids.parquet"])
def test_open_index_names_torn_or_missing_file(table: str, tmp_path: Path, name: str) -> None:
    out = tmp_path / "index"
    build(table, out)
    whole = (out / name).read_bytes()
    (out / name).write_bytes(whole[:-7])
    with pytest.raises(InputError, match=f"{name} has .* bytes, expected .*build the index again"):
        Index(str(out))
    (out / name).unlink()
    with pytest.raises(InputError, match=f"{name} is missing"):
        Index(str(out))
    (out / name).write_bytes(os.urandom(len(whole)))
    if name != "ids.parquet":  # which searching does not read
        with pytest.raises(InputError, match="is damaged"):
            Index(str(out))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda entries: entries | {"schema_version": 1}, "is of version 1, expected 3"),
        (lambda entries: {k: v for k, v in entries.items() if k != "parts"}, "is damaged"),
        (lambda entries: entries | {"parts": [{"faiss": 3}]}, "is damaged"),
        (lambda entries: [entries], "is damaged"),
    ],
)
def test_open_index_rejects_invalid_metadata(
    table: str, tmp_path: Path, change: object, sentence: str
) -> None:
    out = tmp_path / "index"
    build(table, out)
    changed = change(json_files.read_checksummed(str(out / "index.json")))  # type: ignore[operator]
    if isinstance(changed, dict):
        json_files.write_checksummed(str(out / "index.json"), changed)
    else:
        storage.write_json(str(out / "index.json"), changed)
    with pytest.raises(InputError, match=sentence):
        Index(str(out))
