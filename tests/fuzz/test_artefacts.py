"""Our own files, damaged or written by somebody else: opened,
or refused in a sentence; nothing outside of their folder is named."""

import dataclasses
import io
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.integrity import FileChecksum
from pipeline.core.json_files import (
    CHECKSUM_KEY,
    checksum_of,
    is_file_name,
    read_checksummed,
)
from pipeline.core.records import Rejection, Split, View
from pipeline.features.encoding import EncodingConfig
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.features.rejected import read_rejected
from pipeline.features.row_reader import RowReader
from pipeline.features.table import open_table, verify_table
from pipeline.index.metadata import (
    IndexMetadata,
    PartMetadata,
    SearchParams,
    metadata_dict,
    read_metadata,
)
from pipeline.locate.calibration import (
    FEATURE_NAMES,
    Calibration,
    read_calibration,
    write_calibration,
)
from pipeline.locate.logistic import LogisticModel
from pipeline.locate.reliability import ReliabilityBin
from pipeline.report.inputs import read_evaluation, read_training
from pipeline.shards.manifest import Manifest, Shard, read_manifest
from pipeline.shards.pack import find_finished
from pipeline.shards.record_table import Packed, read_packed, read_part
from pipeline.shards.record_table import write_part as write_records
from pipeline.shards.settings import PackingSettings
from pipeline.simulation.settings import SimulationSettings
from pipeline.simulation.simulate import simulate
from tests.fuzz.bounds import bounded, examples
from tests.fuzz.hostile import damaged, twisted

SHARD = Shard(
    name="query-drone-000000",
    split=Split.QUERY,
    view=View.DRONE,
    samples=2,
    bytes=10240,
    sha256="0" * 64,
)
MANIFEST = Manifest(
    shards=(SHARD, dataclasses.replace(SHARD, name="query-drone-000001")),
    classes=("0001",),
    packing={"source": "photos"},
    rejected=0,
)
FILE = FileChecksum(bytes=10, sha256="0" * 64)
FACTS = IndexMetadata(
    factory="Flat",
    metric="inner product",
    rows=2,
    dimension=4,
    fingerprint="0" * 64,
    encoding=EncodingConfig(mirror=True, resizer="torch", precision="float32"),
    table="/nowhere",
    settings={"split": None},
    reason="small",
    refine="none",
    on_disk=False,
    search_params=SearchParams(nprobe_or_ef=1),
    target_recall=0.95,
    unit_rows=2,
    part_rows=2,
    training_sample=0,
    build_seconds=0.1,
    bytes_per_vector=16.0,
    expected_bytes=None,
    measured={"recall_at_1": 1.0},
    parts=(
        PartMetadata(
            faiss="index.faiss",
            ids="ids.arrow",
            first_row=0,
            rows=2,
            table_parts={"query-drone-000000.parquet": "0" * 64},
            files={"index.faiss": FILE, "ids.arrow": FILE},
        ),
    ),
    trained={"trained.faiss": FILE},
)
NUMBERS = (0.1,) * len(FEATURE_NAMES)
CONFIDENCE = Calibration(
    fingerprint="0" * 64,
    gallery_rows=2,
    photo_selection="photos",
    spacing_m=20.0,
    agreement_radius_m=50.0,
    tolerance_m=25.0,
    outside=0.5,
    model=LogisticModel(mean_F=NUMBERS, scale_F=NUMBERS, coefficient_F=NUMBERS, intercept=0.0),
    threshold=0.5,
    inverse_temperature=1.0,
    none_log_odds=0.0,
    photos=10,
    locations=5,
    accuracy=0.5,
    right_kept=0.5,
    outside_unknown=0.5,
    calibration_error=0.1,
    bins=(ReliabilityBin(predicted=0.5, observed=0.5, share=1.0),),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("artefacts")


def put(data: st.DataObject, path: Path, value: Any, checksum: bool = True) -> None:
    """The value, twisted, as JSON with a valid checksum; now and then damaged as text too."""
    twisted_value = data.draw(twisted(value))
    if checksum and isinstance(twisted_value, dict):
        twisted_value |= {CHECKSUM_KEY: checksum_of(twisted_value)}
    text = json.dumps(twisted_value).encode()
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(text if data.draw(st.integers(0, 3)) else data.draw(damaged(text)))


@given(st.data())
@examples(120)
def test_a_manifest(folder: Path, data: st.DataObject) -> None:
    put(data, folder / "set" / "manifest.json", dataclasses.asdict(MANIFEST))
    with bounded(InputError):
        found = read_manifest(str(folder / "set"))
        assert all(is_file_name(shard.name) and shard.samples >= 0 for shard in found.shards)
        assert all(isinstance(name, str) for name in found.classes)
    for extend in (False, True):
        with bounded(InputError):
            find_finished(
                PackingSettings(root="x", out=str(folder / "set"), extend=extend),
                {"source": "photos"},
            )


@pytest.mark.parametrize(
    "name", ["../../evil", "/etc/passwd", "a/b", "..", "", ".hidden", "a\\b", "a\0b", "\ud800"]
)
def test_a_shards_name_that_leads_elsewhere_is_refused(name: str, folder: Path) -> None:
    (folder / "set").mkdir(exist_ok=True)
    said = dataclasses.asdict(MANIFEST)
    said["shards"][0]["name"] = name
    text = json.dumps(said | {CHECKSUM_KEY: checksum_of(said)})
    (folder / "set" / "manifest.json").write_text(text)
    with pytest.raises(InputError, match=r"manifest\.json is damaged"):
        read_manifest(str(folder / "set"))


@given(st.data())
@examples(120)
def test_what_an_index_says_of_itself(folder: Path, data: st.DataObject) -> None:
    put(data, folder / "index" / "index.json", metadata_dict(FACTS))
    with bounded(InputError):
        found = read_metadata(str(folder / "index"))
        assert all(is_file_name(name) for part in found.parts for name in part.files)


@given(st.data())
@examples(80)
def test_a_calibration(folder: Path, data: st.DataObject) -> None:
    path = folder / "calibration.json"
    write_calibration(str(path), CONFIDENCE)
    put(data, path, read_checksummed(str(path)))
    with bounded(InputError):
        found = read_calibration(str(path), "0" * 64)
        assert np.isfinite(found.model.probabilities(np.zeros((1, len(FEATURE_NAMES))))).all()


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
def test_a_part_of_a_feature_table(folder: Path, data: st.DataObject) -> None:
    """Mostly the footer: pyarrow reads it in C++, and believes its lengths."""
    whole = part()
    at = len(whole) - 8 - int.from_bytes(whole[-8:-4], "little")
    told = (
        whole[:at] + data.draw(damaged(whole[at:]))
        if data.draw(st.integers(0, 3))
        else data.draw(damaged(whole))
    )
    (folder / "table").mkdir(exist_ok=True)
    (folder / "table" / "part.parquet").write_bytes(told)
    with bounded(InputError):
        open_table(str(folder / "table")).labels()
    with bounded(InputError):
        verify_table(str(folder / "table"))
    with bounded(InputError):
        RowReader(str(folder / "table"), 8).read("part.parquet", "0" * 64, np.array([0, 49, 7]))


@given(st.data())
@examples(60)
def test_a_part_of_the_record_table(folder: Path, data: st.DataObject) -> None:
    (folder / "records").mkdir(exist_ok=True)
    whole = records()
    at = len(whole) - 8 - int.from_bytes(whole[-8:-4], "little")
    (folder / "records" / "query-drone-000000.parquet").write_bytes(
        whole[:at] + data.draw(damaged(whole[at:]))
    )
    with bounded():
        read_packed(str(folder), "query-drone-000000")
    with bounded(InputError):
        read_part(str(folder), "query-drone-000000", ["key", "path", "bytes"]).to_pylist()


@given(st.data())
@examples(40)
def test_a_list_of_refused_images(folder: Path, data: st.DataObject) -> None:
    (folder / "refused" / "_rejected").mkdir(parents=True, exist_ok=True)
    (folder / "refused" / "_rejected" / "rejected.parquet").write_bytes(
        data.draw(damaged(records()))
    )
    with bounded(InputError):
        read_rejected(str(folder / "refused"))


@given(st.data())
@examples(40)
def test_a_simulation_that_was_begun(folder: Path, data: st.DataObject) -> None:
    settings = SimulationSettings(
        out=str(folder / "flights"), train_locations=1, test_locations=0, distractors=0
    )
    said = {
        name: value
        for name, value in dataclasses.asdict(settings).items()
        if name not in ("out", "textures")
    }
    put(data, folder / "flights" / "simulation.json", said | {"views": 55})
    with bounded(InputError):
        simulate(settings)


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
def test_a_finished_evaluation_and_a_runs_curves(folder: Path, data: st.DataObject) -> None:
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
