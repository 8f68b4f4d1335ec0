"""Parquet artefacts and results, damaged: read, or rejected in one sentence."""

import io
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import Rejection
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.features.rejected import read_rejected
from pipeline.features.row_reader import RowReader
from pipeline.features.table import open_table, verify_table
from pipeline.report.inputs import read_evaluation, read_training
from pipeline.shards.record_table import Packed, read_packed, read_part
from pipeline.shards.record_table import write_part as write_records
from tests.fuzz.bounds import bounded, examples
from tests.fuzz.hostile import damaged
from tests.fuzz.test_artefacts import SHARD, put


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("artefacts")


@cache
def part() -> bytes:
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(50, 8)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    rows = PartRows(
        keys=[f"k{n}" for n in range(50)],
        locations=["a"] * 50,
        views=["drone"] * 50,
        splits=["query"] * 50,
        lats=[1.0] * 50,
        lons=[None] * 50,
        embeddings_BD=vectors,
    )
    rejected = (Rejection(path="k", reason="r", found="f"),)
    write_part(
        "memory://fuzz/part.parquet",
        rows,
        PartFooter(fingerprint="f" * 64, shard_sha256="0" * 64, rows=50, rejected=rejected),
    )
    return storage.read_bytes("memory://fuzz/part.parquet")


@cache
def records() -> bytes:
    row = dict.fromkeys(
        (
            "key",
            "location",
            "view",
            "split",
            "variant",
            "shard",
            "source",
            "path",
            "part",
            "sha256",
        ),
        "x",
    )
    write_records(
        "memory://fuzz",
        Packed(shard=SHARD, plan="0", rejected=()),
        [row | {"bytes": 1, "width": 1, "height": 1}] * 20,
    )
    return storage.read_bytes("memory://fuzz/records/query-drone-000000.parquet")


@given(st.data())
@examples(120)
def test_damaged_feature_part_is_read_or_rejected(folder: Path, data: st.DataObject) -> None:
    """Mostly the footer: pyarrow reads it in C++, and believes its lengths."""
    intact = part()
    at = len(intact) - 8 - int.from_bytes(intact[-8:-4], "little")
    content = (
        intact[:at] + data.draw(damaged(intact[at:]))
        if data.draw(st.integers(0, 3))
        else data.draw(damaged(intact))
    )
    (folder / "table").mkdir(exist_ok=True)
    (folder / "table" / "part.parquet").write_bytes(content)
    with bounded(InputError):
        open_table(str(folder / "table")).labels()
    with bounded(InputError):
        verify_table(str(folder / "table"))
    with bounded(InputError):
        RowReader(str(folder / "table"), 8).read("part.parquet", "0" * 64, np.array([0, 49, 7]))


@given(st.data())
@examples(60)
def test_damaged_record_table_is_read_or_rejected(folder: Path, data: st.DataObject) -> None:
    (folder / "records").mkdir(exist_ok=True)
    intact = records()
    at = len(intact) - 8 - int.from_bytes(intact[-8:-4], "little")
    (folder / "records" / "query-drone-000000.parquet").write_bytes(
        intact[:at] + data.draw(damaged(intact[at:]))
    )
    with bounded():
        read_packed(str(folder), "query-drone-000000")
    with bounded(InputError):
        read_part(str(folder), "query-drone-000000", ["key", "path", "bytes"]).to_pylist()


@given(st.data())
@examples(40)
def test_damaged_rejections_are_read_or_rejected(folder: Path, data: st.DataObject) -> None:
    (folder / "refused" / "_rejected").mkdir(parents=True, exist_ok=True)
    (folder / "refused" / "_rejected" / "rejected.parquet").write_bytes(
        data.draw(damaged(records()))
    )
    with bounded(InputError):
        read_rejected(str(folder / "refused"))


METRICS = [
    {
        "task": "drone->satellite",
        "protocol": "full",
        "multi_query": False,
        "queries": 2,
        "gallery": 2,
        "r1": 1.0,
        "r5": 1.0,
        "r10": 1.0,
        "r1p": 1.0,
        "ap": 1.0,
    }
]


@given(st.data())
@examples(60)
def test_damaged_evaluation_and_curves_are_read_or_rejected(
    folder: Path, data: st.DataObject
) -> None:
    out = folder / "evaluation"
    out.mkdir(exist_ok=True)
    stream = io.BytesIO()
    pq.write_table(pq.read_table(io.BytesIO(part())), stream)
    (out / "queries.parquet").write_bytes(
        data.draw(damaged(stream.getvalue())) if data.draw(st.booleans()) else stream.getvalue()
    )
    put(data, out / "metrics.json", METRICS)
    put(data, out / "views.json", METRICS)
    with bounded(InputError):
        read_evaluation(str(out))
    put(data, out / "metrics.jsonl", {"epoch": 1, "step": 3}, checksum=False)
    with bounded(InputError):
        read_training(str(out))
