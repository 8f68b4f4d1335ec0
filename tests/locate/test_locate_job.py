"""The locate job: single photos, folders as one, near a position, flights; damaged photos are
listed."""

import csv
import io
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from jobs.encoding.encoder import encoder_fingerprint
from jobs.encoding.photo_encoder import PhotoEncoder
from jobs.stages.locate import locate, locate_photos
from jobs.stages.settings import LocateSettings
from model.checkpoint import Checkpoint, dumps, loads
from model.config import PVDAConfig
from pipeline.core import storage
from pipeline.core.errors import Incomplete, InputError
from pipeline.core.geo import Circle
from pipeline.features.encoding import EncodingConfig
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.images import optional_formats
from pipeline.images.transforms import resize
from pipeline.index.build import build_index
from pipeline.index.settings import IndexSettings
from pipeline.locate.calibration import write_calibration
from tests.conftest import make_lively_encoder
from tests.locate.calibrations import make_calibration

pytestmark = pytest.mark.slow

LOCATIONS = 12
STEP = 1e-3  # degrees between locations, about 111 m
ENCODING = EncodingConfig(mirror=True, resizer="torch", precision="float32")


def photo(number: int, blur: int = 80) -> bytes:
    """The colours of a location, and as another camera sees them for another `blur`."""
    cells = np.random.default_rng(number).integers(0, 256, size=(6, 6, 3), dtype=np.uint8)
    stream = io.BytesIO()
    Image.fromarray(resize(cells, blur)).save(stream, "JPEG", quality=95)
    return stream.getvalue()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A checkpoint, an index of locations north of each other, and a folder with a photo of each of
    the first four; the fingerprint of the encoder."""
    folder = tmp_path_factory.mktemp("made")
    encoder = make_lively_encoder()
    network = PVDAConfig(backbone="resnet18", width=0.25, image_size=64, parts=2, part_dim=16)
    state = {"modules": {"encoder": encoder.state_dict()}}
    data = dumps(
        Checkpoint(network=network, recipe={}, locations=[], epoch=0, history=[], state=state)
    )
    (folder / "last.pt").write_bytes(data)
    mark = encoder_fingerprint(loads(data), ENCODING)
    rows_ND, _ = PhotoEncoder(data, "last.pt", mark, ENCODING).encode(
        [photo(number) for number in range(LOCATIONS)]
    )
    names = [f"{number:04d}" for number in range(LOCATIONS)]
    rows = PartRows(
        keys=[f"gallery-satellite-{name}-{name}" for name in names],
        locations=names,
        views=["satellite"] * LOCATIONS,
        splits=["gallery"] * LOCATIONS,
        lats=[46 + STEP * number for number in range(LOCATIONS)],
        lons=[8.0] * LOCATIONS,
        embeddings_BD=rows_ND,
    )
    footer = PartFooter(fingerprint=mark, shard_sha256="s", rows=LOCATIONS, encoding=ENCODING)
    write_part(str(folder / "table" / "gallery-satellite-000000.parquet"), rows, footer)
    build_index(IndexSettings(table=str(folder / "table"), out=str(folder / "index")))
    sized = replace(rows, sides_m=[55.0] * LOCATIONS)
    write_part(str(folder / "sized-table" / "gallery-satellite-000000.parquet"), sized, footer)
    build_index(IndexSettings(table=str(folder / "sized-table"), out=str(folder / "sized")))
    (folder / "photos").mkdir()
    for number in range(4):
        (folder / "photos" / f"{number}.jpg").write_bytes(photo(number, 96))
    return folder, mark


@pytest.fixture
def world(tmp_path: Path, made: tuple[Path, str]) -> dict[str, str]:
    """A copy of what was made, and where the answers go."""
    folder, mark = made
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    paths = {name: str(tmp_path / name) for name in ("index", "sized", "photos")}
    return paths | {
        "checkpoint": str(tmp_path / "last.pt"),
        "out": str(tmp_path / "out.geojson"),
        "mark": mark,
    }


def settings(world: dict[str, str], **changes: Any) -> LocateSettings:
    given = {"photos": (world["photos"],)} | {
        name: world[name] for name in ("checkpoint", "index", "out")
    }
    return LocateSettings(**(given | changes))


def calibrated(world: dict[str, str]) -> None:
    confidence = make_calibration(
        fingerprint=world["mark"],
        gallery_rows=LOCATIONS,
        spacing_m=111.0,
        agreement_radius_m=50.0,
        inverse_temperature=5000.0,
        none_log_odds=0.0,
    )
    write_calibration(f"{world['index']}/calibration.json", confidence)


def test_locate_photos_at_their_positions(world: dict[str, str], tmp_path: Path) -> None:
    located = locate_photos(
        settings(world, csv=str(tmp_path / "out.csv"), page=str(tmp_path / "out.html"))
    )
    assert [one.answer and one.answer.location for one in located] == [
        "0000",
        "0001",
        "0002",
        "0003",
    ]
    points = [
        feature["geometry"]["coordinates"]
        for feature in json.loads(Path(world["out"]).read_text())["features"]
    ]
    assert np.allclose(points, [[8.0, 46 + STEP * number] for number in range(4)])
    assert len(list(csv.DictReader(io.StringIO((tmp_path / "out.csv").read_text())))) == 4
    page = (tmp_path / "out.html").read_text()
    assert "46.003000, 8.000000" in page
    assert "Not calibrated" in page


def test_locate_top_sets_number_of_candidates(world: dict[str, str]) -> None:
    located = locate_photos(settings(world, top=3))
    assert [len(one.answer.candidates) for one in located if one.answer] == [3] * 4


def test_locate_together_is_one_query_per_folder(world: dict[str, str]) -> None:
    (one,) = locate_photos(settings(world, together=True))
    assert one.name == world["photos"]
    assert len(one.photos) == 4
    assert one.answer is not None


def test_locate_frames_photos_as_tiles_of_a_known_size(world: dict[str, str]) -> None:
    """Without the tiles' pixels: their sides are in the index."""
    camera = {"fov": 60.0, "height": 100.0, "heading": 0.0, "pitch": -90.0}
    sized = world | {"index": world["sized"]}
    assert framings(sized, **camera) == {"ground"}
    assert framings(sized, heading=90.0) == {"north"}
    assert framings(sized, **camera, together=True) == {"none"}
    assert framings(world, **camera) == {"none"}  # nobody knows how large its tiles are


def framings(world: dict[str, str], **changes: Any) -> set[str]:
    """How the photos of a call were framed."""
    answers = [one.answer for one in locate_photos(settings(world, **changes))]
    return {answer.framing for answer in answers if answer is not None}


def test_locate_near_restricts_candidates(world: dict[str, str]) -> None:
    located = locate_photos(
        settings(world, near=Circle(lat=46 + STEP * 2, lon=8.0, radius_m=150.0))
    )
    found = {hit.location for one in located if one.answer for hit in one.answer.candidates}
    assert found == {"0001", "0002", "0003"}


def test_locate_damaged_photo_is_listed_and_incomplete(
    world: dict[str, str],
) -> None:
    (Path(world["photos"]) / "0a.jpg").write_bytes(b"\xff\xd8\xff no image")
    with pytest.raises(Incomplete, match=r"1 of 5 photos could not be decoded: .*out.geojson"):
        locate(settings(world))
    features = json.loads(Path(world["out"]).read_text())["features"]
    assert [len(feature["properties"]["rejected"]) for feature in features] == [0, 1, 0, 0, 0]
    assert [feature["geometry"] is None for feature in features] == [
        False,
        True,
        False,
        False,
        False,
    ]


def test_locate_undecoded_formats_are_named(
    world: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(optional_formats, "find_spec", lambda module: None)
    for name in ("4.HEIC", "5.DNG", "6.avif"):
        container = b"II*\0" if name == "5.DNG" else b"\0\0\0\x20ftyp" + name[2:].lower().encode()
        (Path(world["photos"]) / name).write_bytes(container + bytes(99))
    with pytest.raises(Incomplete, match=r"3 of 7 photos could not be decoded"):
        locate(settings(world))
    features = json.loads(Path(world["out"]).read_text())["features"]
    reasons = [one["reason"] for f in features for one in f["properties"]["rejected"]]
    assert reasons == [f"format not decoded (.{ending})" for ending in ("heic", "dng", "avif")]


def test_locate_unreadable_photo_is_rejected(world: dict[str, str], monkeypatch: Any) -> None:
    plain = storage.read_bytes

    def failing(path: str) -> bytes:
        if path.endswith("1.jpg"):
            raise PermissionError("not yours")
        return plain(path)

    monkeypatch.setattr(storage, "read_bytes", failing)
    located = locate_photos(settings(world))
    assert [[(one.reason, one.found) for one in photo.rejected] for photo in located] == [
        [], [("unreadable file", "not yours")], [], [],
    ]  # fmt: skip


def test_locate_track_in_order_of_times(world: dict[str, str]) -> None:
    """100 m in 10 s are within 25 m/s, so the track passes through the photos' own locations; the
    output begins with the earliest."""
    calibrated(world)
    times = Path(world["photos"]).with_name("times.csv")
    times.write_text(
        "photo,time\n" + "".join(f"{number}.jpg,{100 - 10 * number}\n" for number in range(4))
    )
    located = locate_photos(settings(world, track=True, times=str(times)))
    assert [one.taken_at for one in located] == ["70", "80", "90", "100"]
    assert [one.answer and one.answer.location for one in located] == [
        "0003",
        "0002",
        "0001",
        "0000",
    ]
    line = json.loads(Path(world["out"]).read_text())["features"][0]
    assert line["geometry"]["type"] == "LineString"
    assert len(line["geometry"]["coordinates"]) == 4


def test_locate_track_without_times_or_calibration_is_refused(world: dict[str, str]) -> None:
    with pytest.raises(InputError, match=r"no calibration beside .*--track"):
        locate_photos(settings(world, track=True))
    calibrated(world)
    with pytest.raises(InputError, match=r"4 of 4 photos have no time in their tags.*--interval"):
        locate_photos(settings(world, track=True))
    assert len(locate_photos(settings(world, track=True, interval=5.0))) == 4


def test_locate_track_online_by_odometry(world: dict[str, str]) -> None:
    """Steps of 111 m north, as flown; the table is refused where a number is none."""
    calibrated(world)
    table = Path(world["photos"]).with_name("way.csv")
    rows = [f"{number}.jpg,0,{111 * (number > 0)},3" for number in range(4)]
    table.write_text("photo,east_m,north_m,error_m\n" + "\n".join(rows))
    given = settings(world, track=True, interval=5.0, online=True, odometry=str(table))
    located = locate_photos(given)
    assert [one.answer and one.answer.location for one in located] == [
        "0000", "0001", "0002", "0003",
    ]  # fmt: skip
    table.write_text("photo,east_m,north_m,error_m\n0.jpg,0,1,x\n")
    with pytest.raises(InputError, match=r"has 0, 1, x for 0\.jpg; expected metres"):
        locate_photos(given)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"top": 0}, "--top is 0"),
        ({"online": True}, "found --online without --track"),
        ({"odometry": "way.csv"}, "found --odometry without --track"),
        ({"together": True, "track": True}, "both --together and --track"),
        ({"interval": -1.0}, "--interval is -1"),
        ({"max_speed": 0.0}, "--max-speed is 0"),
        ({"checkpoint": "nowhere.pt"}, "no checkpoint at nowhere.pt"),
    ],
)
def test_locate_wrong_call_is_refused_before_any_work(
    world: dict[str, str], changes: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        locate_photos(settings(world, **changes))
    assert not Path(world["out"]).exists()
