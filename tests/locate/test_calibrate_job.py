"""The calibrate job: which photos it uses, the files it writes, and the input it refuses."""

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from jobs.encoding.encoder import encoder_fingerprint
from jobs.encoding.photo_encoder import PhotoEncoder
from jobs.stages.calibrate import calibrate_index
from jobs.stages.settings import CalibrateSettings
from model.checkpoint import Checkpoint, dumps, loads
from model.config import PVDAConfig
from model.pvda import FeatureEncoder
from pipeline.core.errors import InputError
from pipeline.features.encoding import EncodingConfig
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.images.transforms import resize
from pipeline.index.build import build_index
from pipeline.index.settings import IndexSettings
from pipeline.locate.calibration import find_calibration
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.sources.university1652 import University1652

HELD_OUT, TRAINED, GALLERY_ROWS = 20, 3, 40
ENCODING = EncodingConfig(mirror=True, resizer="torch", precision="float32")


def image(seed: int, size: int = 64) -> bytes:
    cells = np.random.default_rng(seed).integers(0, 256, size=(6, 6, 3), dtype=np.uint8)
    stream = io.BytesIO()
    Image.fromarray(resize(cells, size)).save(stream, "JPEG", quality=95)
    return stream.getvalue()


@pytest.fixture
def world(tmp_path: Path, ray_cluster: None, lively_encoder: FeatureEncoder) -> dict[str, Any]:
    """Shards of 23 training locations, of which three were trained on; of each, one photo shows the
    same as its satellite image, and another one something else. An index of forty other
    locations."""
    for number in range(HELD_OUT + TRAINED):
        for view, seeds in (("satellite", [number]), ("drone", [number, 1000 + number])):
            folder = tmp_path / "raw" / "train" / view / f"{number:04d}"
            folder.mkdir(parents=True)
            for index, seed in enumerate(seeds):
                (folder / f"{index}.jpg").write_bytes(
                    image(seed, 64 if view == "satellite" else 70)
                )
    pack(
        University1652(), PackingSettings(root=str(tmp_path / "raw"), out=str(tmp_path / "shards"))
    )
    network = PVDAConfig(backbone="resnet18", width=0.25, image_size=64, parts=2, part_dim=16)
    state = {"modules": {"encoder": lively_encoder.state_dict()}}
    plain = Checkpoint(network=network, recipe={}, locations=[], epoch=0, history=[], state=state)
    data = dumps(replace(plain, locations=[f"{number:04d}" for number in range(TRAINED)]))
    (tmp_path / "last.pt").write_bytes(data)
    mark = encoder_fingerprint(loads(data), ENCODING)
    rows_ND, _ = PhotoEncoder(data, "last.pt", mark, ENCODING).encode(
        [image(5000 + n) for n in range(GALLERY_ROWS)]
    )
    names = [f"g{number}" for number in range(GALLERY_ROWS)]
    rows = PartRows(
        keys=names,
        locations=names,
        views=["satellite"] * GALLERY_ROWS,
        splits=["gallery"] * GALLERY_ROWS,
        lats=[None] * GALLERY_ROWS,
        lons=[None] * GALLERY_ROWS,
        embeddings_BD=rows_ND,
    )
    footer = PartFooter(fingerprint=mark, shard_sha256="s", rows=GALLERY_ROWS, encoding=ENCODING)
    write_part(str(tmp_path / "table" / "gallery-satellite-000000.parquet"), rows, footer)
    build_index(IndexSettings(table=str(tmp_path / "table"), out=str(tmp_path / "index")))
    return {
        "checkpoint": str(tmp_path / "last.pt"),
        "shards": str(tmp_path / "shards"),
        "index": str(tmp_path / "index"),
    }


def test_calibrate_job_uses_held_out_locations(
    world: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = calibrate_index(CalibrateSettings(**world))
    assert (made.photos, made.locations) == (2 * HELD_OUT, HELD_OUT)
    assert made.accuracy == pytest.approx(
        0.5, abs=0.1
    )  # a photo of something else may hit by chance
    assert (made.gallery_rows, made.spacing_m, made.agreement_radius_m) == (GALLERY_ROWS, None, 0)
    metadata = json.loads((tmp_path / "index" / "index.json").read_text())
    assert find_calibration(world["index"], metadata["fingerprint"]) == made
    assert (tmp_path / "index" / "calibration.svg").read_text().startswith("<svg")
    capsys.readouterr()
    assert calibrate_index(CalibrateSettings(**world)) == made
    assert "nothing to do" in capsys.readouterr().err
    assert calibrate_index(CalibrateSettings(**world, outside=0.2)).outside == 0.2
    assert calibrate_index(CalibrateSettings(**world, outside=0.2, photos=30)).photos == 30
    (tmp_path / "index" / "calibration.json").write_text("{}")
    assert calibrate_index(CalibrateSettings(**world)) == made


def test_calibrate_job_too_few_locations_are_refused(world: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="5 photos of"):
        calibrate_index(CalibrateSettings(**world, photos=5))
    with pytest.raises(InputError, match="no checkpoint at nowhere"):
        calibrate_index(CalibrateSettings(**world | {"checkpoint": "nowhere.pt"}))
    assert not (tmp_path / "index" / "calibration.json").exists()
