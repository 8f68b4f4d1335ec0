"""Our JSON artefacts, damaged or foreign: read, or rejected in one sentence.

No name in them may lead outside their folder.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.errors import InputError
from pipeline.core.json_files import (
    CHECKSUM_KEY,
    checksum_of,
    is_file_name,
    read_checksummed,
)
from pipeline.core.records import Split, View
from pipeline.index.metadata import (
    metadata_dict,
    read_metadata,
)
from pipeline.locate.calibration import (
    FEATURE_NAMES,
    read_calibration,
    write_calibration,
)
from pipeline.shards.manifest import Manifest, Shard, read_manifest
from pipeline.shards.pack import find_finished
from pipeline.shards.settings import PackingSettings
from pipeline.simulation.settings import SimulationSettings
from pipeline.simulation.simulate import simulate
from tests.fuzz.bounds import bounded, examples
from tests.fuzz.hostile import damaged, twisted
from tests.index.metadata_builder import make_metadata
from tests.locate.calibrations import make_calibration

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
def test_damaged_manifest_is_read_or_rejected(folder: Path, data: st.DataObject) -> None:
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
def test_shard_name_outside_the_folder_is_rejected(name: str, folder: Path) -> None:
    (folder / "set").mkdir(exist_ok=True)
    metadata = dataclasses.asdict(MANIFEST)
    metadata["shards"][0]["name"] = name
    text = json.dumps(metadata | {CHECKSUM_KEY: checksum_of(metadata)})
    (folder / "set" / "manifest.json").write_text(text)
    with pytest.raises(InputError, match=r"manifest\.json is damaged"):
        read_manifest(str(folder / "set"))


@given(st.data())
@examples(120)
def test_damaged_index_metadata_is_read_or_rejected(folder: Path, data: st.DataObject) -> None:
    put(data, folder / "index" / "index.json", metadata_dict(make_metadata()))
    with bounded(InputError):
        found = read_metadata(str(folder / "index"))
        assert all(is_file_name(name) for part in found.parts for name in part.files)


@given(st.data())
@examples(80)
def test_damaged_calibration_is_read_or_rejected(folder: Path, data: st.DataObject) -> None:
    path = folder / "calibration.json"
    write_calibration(str(path), make_calibration(fingerprint="0" * 64))
    put(data, path, read_checksummed(str(path)))
    with bounded(InputError):
        found = read_calibration(str(path), "0" * 64)
        assert np.isfinite(found.model.probabilities(np.zeros((1, len(FEATURE_NAMES))))).all()


@given(st.data())
@examples(40)
def test_damaged_simulation_json_is_rejected_or_complete(folder: Path, data: st.DataObject) -> None:
    settings = SimulationSettings(
        out=str(folder / "flights"), train_locations=1, test_locations=0, distractors=0
    )
    metadata = {
        name: value
        for name, value in dataclasses.asdict(settings).items()
        if name not in ("out", "textures")
    }
    put(data, folder / "flights" / "simulation.json", metadata | {"views": 55})
    with bounded(InputError):
        simulate(settings)
