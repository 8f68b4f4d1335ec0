"""Damage to an index is found before FAISS reads it; a killed build reuses intact files only."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.core.integrity import checksum_ok, write_checksum
from pipeline.core.records import Split, View
from pipeline.evaluation.evaluate import plan_tasks
from pipeline.evaluation.settings import EvaluationSettings
from pipeline.features.table import open_table
from pipeline.index.build import build_index
from pipeline.index.searcher import Index
from pipeline.index.settings import IndexSettings
from pipeline.index.update import extend_index, verify_index
from tests.damaging import count_detected, damaged_versions, raising_if_missing
from tests.index.index_tables import write_gallery


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(write_gallery(tmp_path_factory.mktemp("table"), parts=4, rows=100))


def settings(table: str, out: Path, **changes: Any) -> IndexSettings:
    given: dict[str, Any] = {
        "table": table,
        "out": str(out),
        "split": Split.GALLERY,
        "view": View.SATELLITE,
        "target_recall": 0.5,
        "factory": "IVF8,SQ8",
        "refine": True,
    }
    return IndexSettings(**(given | changes))


@pytest.fixture(scope="module")
def built(table: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("index")
    build_index(settings(table, out))
    return out


def answers(out: Path, table: str) -> list[Any]:
    found = Index(str(out)).search(open_table(table).select(Split.QUERY).embeddings()[:3], 5)
    return [[(hit.key, hit.location, hit.lat, hit.score) for hit in hits] for hits in found]


@pytest.mark.parametrize("name", ["index.faiss", "ids.arrow", "ids.parquet"])
def test_index_file_damaged_is_rejected_before_opening(
    name: str, table: str, built: Path, tmp_path: Path
) -> None:
    out = Path(shutil.copytree(built, tmp_path / "index"))
    assert count_detected(out / name, lambda: answers(out, table), 40) == 41


def test_trained_index_is_hashed_when_used(table: str, built: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(built, tmp_path / "index"))
    path = out / "trained.faiss"
    assert count_detected(path, lambda: verify_index(str(out)).rows, 20) == 21
    good = path.read_bytes()
    path.write_bytes(good[:100] + bytes([good[100] ^ 1]) + good[101:])
    more = Path(shutil.copytree(table, tmp_path / "table"))
    write_gallery(more, parts=1, rows=100, first=7)
    with pytest.raises(
        InputError, match=r"trained.faiss holds other bytes than were written.*jobs/build_index.py"
    ):
        extend_index(str(more), str(out))


def test_large_index_is_hashed_by_verify_only(
    table: str, built: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.index.searcher.HASHED_ON_OPEN_BYTES", 0)
    out = Path(shutil.copytree(built, tmp_path / "index"))
    ids = out / "ids.arrow"
    ids.write_bytes(ids.read_bytes().replace(b"gallery", b"gallary", 1))
    answers(out, table)
    with pytest.raises(
        InputError, match=r"ids.arrow holds other bytes than were written.*build the index again"
    ):
        Index(str(out), verify=True)


class Killed(Exception):
    pass


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["unit-000001.faiss", "unit-000001.faiss.json", "trained.faiss", "plan.json"]
)
def test_build_redoes_damaged_work_of_a_killed_build(
    name: str, table: str, built: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.index.planning.plan.MIN_UNIT_ROWS", 100)
    monkeypatch.setattr("pipeline.index.planning.plan.UNIT_SHARE", 0)
    left, expected = tmp_path / "left", answers(built, table)

    def killed(*arguments: Any) -> Any:
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr("pipeline.index.workspace.BuildWorkspace._merge", killed)
        with pytest.raises(Killed):
            build_index(settings(table, left))
    good = (left / "_building" / name).read_bytes()
    *_, cut = damaged_versions(good, 10)
    for number, data in enumerate(
        (None, good[: len(good) // 2] + b"?" + good[len(good) // 2 + 1 :], cut)
    ):
        out = Path(shutil.copytree(left, tmp_path / f"{number}"))
        (out / "_building" / name).unlink()
        if data is not None:
            (out / "_building" / name).write_bytes(data)
        build_index(settings(table, out))
        assert answers(out, table) == expected
        assert (out / "index.faiss").read_bytes() == (built / "index.faiss").read_bytes()


def test_checksum_ok_until_the_file_changes(tmp_path: Path) -> None:
    path = tmp_path / "unit.faiss"
    path.write_bytes(np.random.default_rng(0).bytes(500))
    assert not checksum_ok(str(path))
    write_checksum(str(path))
    look = raising_if_missing(path, lambda: checksum_ok(str(path)))
    assert look()
    good = path.read_bytes()
    for data in damaged_versions(good, 40):
        if data is not None:
            path.write_bytes(data)
            assert checksum_ok(str(path)) == (data == good)


def test_build_verifies_the_table_first(table: str, tmp_path: Path) -> None:
    spoilt = Path(shutil.copytree(table, tmp_path / "table"))
    build_index(settings(str(spoilt), tmp_path / "index", verify=True))
    path = next(spoilt.glob("gallery*"))
    data = bytearray(path.read_bytes())
    data[60] ^= 1
    path.write_bytes(data)
    for out in ("index", "another"):
        with pytest.raises(
            InputError, match=rf"{path} is not a readable Parquet file .*embed its shard again"
        ):
            build_index(settings(str(spoilt), tmp_path / out, verify=True))


def test_evaluate_verify_checks_every_byte_of_tables(table: str, tmp_path: Path) -> None:
    spoilt = Path(shutil.copytree(table, tmp_path / "table"))
    asked = EvaluationSettings(table=str(spoilt), out=str(tmp_path / "out"), verify=True)
    plan_tasks(asked)
    path = next(spoilt.glob("query*"))
    path.write_bytes(path.read_bytes().replace(b"query", b"quary", 1))
    with pytest.raises(
        InputError, match=rf"{path} is not a readable Parquet file .*embed its shard again"
    ):
        plan_tasks(asked)
