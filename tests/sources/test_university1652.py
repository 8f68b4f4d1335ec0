"""University-1652's geotags: from its authors' KML files and from the simulator's tables, and what
damage costs.
"""

from pathlib import Path

import fsspec
import pytest

from pipeline.core.errors import InputError
from pipeline.core.records import GeoTag, ImageRecord, Rejection, View
from pipeline.sources.kml import MAX_KML_BYTES, parse_kml
from pipeline.sources.text_tables import Unreadable
from pipeline.sources.university1652 import University1652

KML = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">
<Document><Placemark><name>0839</name>
<LookAt><longitude>-1.5</longitude><latitude>53.5</latitude><altitude>0</altitude></LookAt>
<Point><coordinates>
  -1.25,53.75,0 </coordinates></Point></Placemark></Document></kml>"""


def touch(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"never opened")


def miniature(root: Path) -> Path:
    for place in ("0839", "0840"):
        touch(root / "train/satellite" / place / f"{place}.jpg")
        touch(root / "train/drone" / place / "image-01.jpeg")
    touch(root / "train/street/0839/1.jpg")
    touch(root / "test/query_drone/0001/image-01.JPEG")
    return root


def scanned(
    root: Path, source: University1652 | None = None
) -> tuple[dict[str, ImageRecord], list[Rejection]]:
    found = list((source or University1652()).scan(str(root)))
    records = {record.key: record for record in found if isinstance(record, ImageRecord)}
    return records, [f for f in found if isinstance(f, Rejection)]


def with_kml(
    tmp_path: Path, files: dict[str, str]
) -> tuple[dict[str, ImageRecord], list[Rejection]]:
    for name, text in files.items():
        path = tmp_path / "kml" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return scanned(miniature(tmp_path / "root"), University1652(kml=str(tmp_path / "kml")))


def test_kml_places_all_images_of_a_building(tmp_path: Path) -> None:
    records, refused = with_kml(tmp_path, {"first-key/0839.kml": KML})
    assert not refused
    for key in ("train-satellite-0839-0839", "train-drone-0839-image-01"):
        assert records[key].geotag == GeoTag(lat=53.75, lon=-1.25)
    assert records["train-drone-0840-image-01"].geotag is None


def test_parse_kml_without_point_uses_look_then_coordinate() -> None:
    look = KML[: KML.index("<Point>")] + "</Placemark></Document></kml>"
    assert parse_kml(look.encode()) == (53.5, -1.5)
    line = "<kml><LineString><coordinates>2.5,48.5,10 3,49,10</coordinates></LineString></kml>"
    assert parse_kml(line.encode()) == (48.5, 2.5)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "not XML"),
        ("hello", "not XML"),
        (KML[:200], "not XML"),
        ("<kml/>", "no Point, LookAt or coordinates"),
        (KML.replace("-1.25,53.75,0", "-1.25"), "expected longitude,latitude"),
        (KML.replace("53.75", "95"), "latitude 95 is not between"),
        (KML.replace("53.75", "nan"), "'nan' is not a finite number"),
        (KML.replace("UTF-8", "no-such-code"), "not XML"),
        (
            '<!DOCTYPE kml [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]><kml>&b;</kml>',
            "declares a document type",
        ),
        ('<!DOCTYPE kml SYSTEM "file:///etc/passwd"><kml/>', "declares a document type"),
        (f"<kml>{' ' * MAX_KML_BYTES}</kml>", "expected at most 1048576"),
    ],
)
def test_kml_without_position_costs_only_its_tag(tmp_path: Path, text: str, said: str) -> None:
    records, refused = with_kml(tmp_path, {"0839.kml": text, "0840.KML": KML})
    assert [(Path(r.path).name, r.reason) for r in refused] == [("0839.kml", "unreadable tag")]
    assert said in refused[0].found
    assert records["train-drone-0839-image-01"].geotag is None
    assert records["train-drone-0840-image-01"].geotag == GeoTag(lat=53.75, lon=-1.25)


def test_parse_kml_document_type_is_refused_in_any_encoding() -> None:
    with pytest.raises(Unreadable, match="declares a document type"):
        parse_kml('<?xml version="1.0" encoding="UTF-16"?><!DOCTYPE kml><kml/>'.encode("utf-16"))


def test_kml_folder_without_kml_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no KML files below .*check --kml"):
        scanned(miniature(tmp_path), University1652(kml=str(tmp_path / "nowhere")))


def test_pose_tables_give_positions_and_poses(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    (root / "locations.csv").write_text("location,lat,lon\n0839,53.75,-1.25\n0840,1,2\n")
    (root / "poses.csv").write_text(
        "path,location,altitude_m,heading_deg,pitch_deg\n"
        "train/drone/0839/image-01.jpeg,0839,120.5,90,-45\n"
    )
    records, refused = scanned(root)
    assert not refused
    tag = GeoTag(lat=53.75, lon=-1.25, altitude_m=120.5, heading_deg=90, pitch_deg=-45)
    assert records["train-drone-0839-image-01"].geotag == tag
    assert records["train-satellite-0839-0839"].geotag == GeoTag(lat=53.75, lon=-1.25)


def test_pose_tables_tell_the_lens(tmp_path: Path) -> None:
    """90 degrees across a square: half its width of focal length, so 43.27 / (2 sqrt(2)) mm."""
    root = miniature(tmp_path)
    (root / "locations.csv").write_text("location,lat,lon\n0839,53.75,-1.25\n")
    (root / "poses.csv").write_text(
        "path,location,altitude_m,heading_deg,pitch_deg,fov_deg\n"
        "train/drone/0839/image-01.jpeg,0839,120.5,90,-45,90\n"
        "train/drone/0839/image-02.jpeg,0839,120.5,90,-45,180\n"
    )
    records, refused = scanned(root)
    tag = records["train-drone-0839-image-01"].geotag
    assert tag is not None
    assert tag.focal_35mm == pytest.approx(15.297, abs=0.001)
    assert [one.found for one in refused if "fov_deg 180" in one.found]


def test_pose_tables_damaged_line_costs_only_its_tag(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    (root / "locations.csv").write_text("location,lat,lon\n0839,north,-1.25\n0840,1,2\n0841\n")
    (root / "poses.csv").write_text(
        "path,location,altitude_m,heading_deg,pitch_deg\n"
        "train/drone/0839/image-01.jpeg,0839,1,2,3\ntrain/drone/0840/image-01.jpeg,0840,inf,2,3\n"
    )
    records, refused = scanned(root)
    assert [(Path(r.path).name, r.reason, r.found.split(":")[0]) for r in refused] == [
        ("locations.csv", "unreadable tag", "line 2"),
        ("locations.csv", "unreadable tag", "line 4"),
        ("poses.csv", "unreadable tag", "line 2"),
        ("poses.csv", "unreadable tag", "line 3"),
    ]
    assert records["train-drone-0839-image-01"].geotag is None
    assert records["train-drone-0840-image-01"].geotag == GeoTag(lat=1, lon=2)


def test_pose_tables_with_other_columns_are_refused(tmp_path: Path) -> None:
    (miniature(tmp_path) / "locations.csv").write_text("id,x,y\n")
    with pytest.raises(
        InputError,
        match="has no column location, lat, lon, its first line holds id, x, y; correct it",
    ):
        scanned(tmp_path)


def test_university1652_odd_folders_and_names(tmp_path: Path) -> None:
    root = miniature(tmp_path)
    touch(root / "train/drone/0839/too deep/image-02.jpeg")
    touch(root / "train/drone/0839/Thumbs.db")
    touch(root / "train/drone/0839/.DS_Store")
    touch(root / "train/drone/école 9/写真 1.JPG")
    (root / "train/drone/0777").mkdir()
    (root / "train/drone/gone").symlink_to(root / "nowhere")
    (root / "train/drone/linked").symlink_to(root / "train/drone/0839/too deep")
    records, refused = scanned(root, University1652(views=tuple(View)))
    assert {record.location for record in records.values()} == {
        "0839",
        "0840",
        "0001",
        "école 9",
        "linked",
    }
    assert "train-street-0839-1" in records
    assert sorted((Path(r.path).name, r.reason) for r in refused) == [
        ("image-02.jpeg", "wrong folder"),
    ]


def test_university1652_is_read_from_other_storage() -> None:
    memory = fsspec.filesystem("memory")
    memory.pipe("/u1652/root/train/drone/0839/image-01.jpeg", b"x")
    memory.pipe("/u1652/kml/0839.kml", KML.encode())
    found = list(University1652(kml="memory://u1652/kml").scan("memory://u1652/root"))
    assert [f.geotag for f in found if isinstance(f, ImageRecord)] == [GeoTag(lat=53.75, lon=-1.25)]


@pytest.mark.parametrize(
    ("shape", "position"),
    [
        ("<Point><coordinates>-1.25, 53.75, 0</coordinates></Point>", (53.75, -1.25)),
        ("<Point><coordinates>\n-1.25 ,53.75 ,0\n</coordinates></Point>", (53.75, -1.25)),
        (
            "<Polygon><outerBoundaryIs><LinearRing><coordinates>8,47 8.2,47 8.2,47.1 8,47.1 8,47"
            "</coordinates></LinearRing></outerBoundaryIs></Polygon>",
            (47.05, 8.1),
        ),
        (
            "<Polygon><coordinates>179.9,-17 -179.7,-17 -179.7,-16.9 179.9,-16.9 179.9,-17"
            "</coordinates></Polygon>",
            (-16.95, -179.9),
        ),
    ],
)
def test_parse_kml_shapes_have_their_middle(shape: str, position: tuple[float, float]) -> None:
    found = parse_kml(f"<kml><Placemark>{shape}</Placemark></kml>".encode())
    assert found == pytest.approx(position, abs=1e-9)


def test_parse_kml_points_far_apart_are_refused() -> None:
    two = (
        "<Point><coordinates>8,47</coordinates></Point><Point><coordinates>{}</coordinates></Point>"
    )
    assert parse_kml(f"<kml>{two.format('8.001,47')}</kml>".encode()) == (47, 8)
    with pytest.raises(Unreadable, match=r"2 points up to 111,\d+ m apart, expected one"):
        parse_kml(f"<kml>{two.format('8,48')}</kml>".encode())


def test_positions_that_contradict_each_other_give_none(tmp_path: Path) -> None:
    (miniature(tmp_path / "root") / "locations.csv").write_text(
        "location,lat,lon\n0839,-53.75,-1.25\n0840,53.75,-1.25\n"
    )
    records, refused = with_kml(tmp_path, {"0839.kml": KML, "0840.kml": KML})
    assert [(Path(r.path).name, r.reason) for r in refused] == [("0839.kml", "unreadable tag")]
    assert "m away, at -53.75, -1.25, elsewhere; it has no position now" in refused[0].found
    assert records["train-drone-0839-image-01"].geotag is None
    assert records["train-drone-0840-image-01"].geotag == GeoTag(lat=53.75, lon=-1.25)
