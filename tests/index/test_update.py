"""Extending, removing and verifying: new parts are found, removed locations are not."""

import json
import shutil
from pathlib import Path

import pytest

from pipeline.core.errors import InputError
from pipeline.core.filters import Filter
from pipeline.core.records import Split, View
from pipeline.features.table import open_table
from pipeline.index import workspace
from pipeline.index.build import build_index
from pipeline.index.searcher import Index
from pipeline.index.settings import IndexSettings
from pipeline.index.update import extend_index, remove_locations, verify_index
from tests.index.index_tables import clustered, write_gallery, write_table_part

pytestmark = pytest.mark.slow

FACTORIES = ["Flat", "IVF8,SQ8", "HNSW16,SQ8", "IVF8,PQ8x4fs"]


@pytest.fixture
def table(tmp_path: Path) -> Path:
    return write_gallery(tmp_path / "table", parts=2)


def build(source: Path, out: Path, factory: str = "Flat") -> str:
    build_index(
        IndexSettings(
            table=str(source),
            out=str(out),
            split=Split.GALLERY,
            view=View.SATELLITE,
            factory=factory,
            target_recall=0.99,
            refine=factory.endswith("fs"),
        )
    )
    return str(out)


def keys(out: str, table: Path, k: int = 8) -> list[list[str]]:
    queries = open_table(str(table)).select(Split.QUERY).embeddings()
    return [[hit.key for hit in hits] for hits in Index(out).search(queries, k)]


@pytest.mark.parametrize("factory", FACTORIES)
def test_extend_finds_new_parts(table: Path, tmp_path: Path, factory: str) -> None:
    out = build(table, tmp_path / "index", factory)
    first = (tmp_path / "index" / "index.faiss").stat().st_mtime_ns
    write_gallery(table, parts=2, first=2)
    with pytest.raises(InputError, match="2 more by now; say --extend"):
        build(table, tmp_path / "index", factory)
    metadata = extend_index(str(table), out)
    assert (metadata.rows, len(Index(out)), len(metadata.parts)) == (800, 800, 2)
    assert metadata.measured["recall_at_10"] >= 0.96
    assert (tmp_path / "index" / "index.faiss").stat().st_mtime_ns == first, (
        "what was there was not built again"
    )
    exact = keys(build(table, tmp_path / "exact"), table)
    found = keys(out, table)
    assert sum(len({*a} & {*b}) for a, b in zip(found, exact, strict=True)) >= 0.95 * 8 * len(exact)
    assert any(key.startswith("gallery-3-") for hits in found for key in hits)
    build(table, tmp_path / "index", factory)  # complete: does nothing


def test_extend_rerun_is_a_no_op_and_ray_is_equal(
    table: Path, tmp_path: Path, ray_cluster: None, capsys: pytest.CaptureFixture[str]
) -> None:
    out, other = (build(table, tmp_path / name, "IVF8,SQ8") for name in ("one", "other"))
    extend_index(str(table), out)
    assert "holds all of" in capsys.readouterr().err
    write_gallery(table, parts=1, first=2)
    extend_index(str(table), out)
    extend_index(str(table), other, workers=1)
    name = "index-000001.faiss"
    assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()


def test_extend_killed_leaves_the_index_unchanged(
    table: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = build(table, tmp_path / "index", "IVF8,SQ8")
    before = keys(out, table)
    write_gallery(table, parts=1, first=2)

    def killed(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(workspace, "write_ids", killed)
    with pytest.raises(KeyboardInterrupt):
        extend_index(str(table), out)
    assert keys(out, table) == before
    monkeypatch.undo()
    assert extend_index(str(table), out).rows == 600


@pytest.mark.parametrize("factory", FACTORIES)
def test_remove_filters_out_locations(table: Path, tmp_path: Path, factory: str) -> None:
    out = build(table, tmp_path / "index", factory)
    places = sorted({key for hits in keys(out, table, 1) for key in hits})
    gone = [f"{key.split('-')[1]}{int(key.split('-')[2]):04d}" for key in places[:5]]
    remove_locations(out, gone)
    left = [
        hit
        for hits in Index(out).search(open_table(str(table)).select(Split.QUERY).embeddings(), 8)
        for hit in hits
    ]
    assert not {hit.location for hit in left} & {*gone}
    assert len(left) == 40 * 8
    assert len(Index(out)) == 395
    assert Index(out).search(clustered(2, 32, 1), 3, Filter(locations=frozenset(gone))) == [[], []]


def test_extend_finds_removed_location_in_new_part(table: Path, tmp_path: Path) -> None:
    out = build(table, tmp_path / "index")
    remove_locations(out, ["10003"])
    write_table_part(table, 7, clustered(1, 32, 77), locations=["10003"])
    extend_index(str(table), out)
    assert [
        hit.key
        for hit in Index(out).search(
            clustered(1, 32, 1), 3, Filter(locations=frozenset(["10003"]))
        )[0]
    ] == ["gallery-7-0"]


def test_remove_unknown_location_removes_nothing(table: Path, tmp_path: Path) -> None:
    out = build(table, tmp_path / "index")
    with pytest.raises(
        InputError,
        match="no rows of 1 of the locations to remove, such as nowhere; nothing was removed",
    ):
        remove_locations(out, ["00001", "nowhere"])
    assert len(Index(out)) == 400
    remove_locations(out, ["00001"])
    with pytest.raises(InputError, match="such as 00001"):
        remove_locations(out, ["00001"])


def test_extend_rejects_table_of_another_network(table: Path, tmp_path: Path) -> None:
    out = build(table, tmp_path / "index")
    other = tmp_path / "other"
    write_table_part(other, 9, clustered(5, 32, 9), fingerprint="e" * 64)
    with pytest.raises(InputError, match=r"is of network ffffffffffff and .* of eeeeeeeeeeee"):
        extend_index(str(other), out)


def test_extend_rejects_changed_table(table: Path, tmp_path: Path) -> None:
    out = build(table, tmp_path / "index", "IVF8,SQ8")
    write_table_part(table, 1, clustered(200, 32, 5), shard="another shard")
    with pytest.raises(InputError, match="no longer holds 1 of the 2 parts"):
        extend_index(str(table), out)
    with pytest.raises(InputError, match="no longer of the shard that the index was built from"):
        Index(out).search(clustered(1, 32, 1), 3, Filter(locations=frozenset(["10003"])))
    shutil.rmtree(table)
    with pytest.raises(
        InputError, match="which is not there; expected the feature table where it was"
    ):
        Index(out).search(clustered(1, 32, 1), 3, Filter(locations=frozenset(["10003"])))
    assert len(Index(out).search(clustered(1, 32, 1), 3)[0]) == 3, (
        "lists of codes answer without the table"
    )


def test_verify_index_finds_a_flipped_bit(table: Path, tmp_path: Path) -> None:
    out = build(table, tmp_path / "index", "IVF8,SQ8")
    assert verify_index(out).rows == 400
    for name in ("index.faiss", "ids.parquet", "ids.arrow", "trained.faiss"):
        path = tmp_path / "index" / name
        whole = bytearray(path.read_bytes())
        whole[len(whole) // 2] ^= 1
        path.write_bytes(whole)
        with pytest.raises(InputError, match=f"{name} holds other bytes than were written"):
            verify_index(out)
        whole[len(whole) // 2] ^= 1
        path.write_bytes(whole)
    verify_index(out)


def test_extend_records_table_parts(table: Path, tmp_path: Path) -> None:
    out = build(table, tmp_path / "index")
    write_gallery(table, parts=1, first=2)
    extend_index(str(table), out)
    facts = json.loads((tmp_path / "index" / "index.json").read_text())
    assert [list(part["table_parts"]) for part in facts["parts"]] == [
        ["gallery-satellite-000000.parquet", "gallery-satellite-000001.parquet"],
        ["gallery-satellite-000002.parquet"],
    ]
