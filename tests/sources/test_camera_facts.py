"""Roll and lens of photos, as tags and tables tell them."""

from pathlib import Path

import pytest

from pipeline.core.records import GeoTag, Rejection
from tests.sources.photo_files import FLOWN, HERE, photo, records
from tests.sources.table_files import images, only, scan


def test_photo_lens_and_roll_are_in_the_geotag(tmp_path: Path) -> None:
    """3,000 pixels of focal length across 4,000 x 3,000: a diagonal of 5,000, so 43.27 * 3 / 5 mm
    on film."""
    tilted = FLOWN.replace(
        b"drone-dji:GimbalYaw",
        b'drone-dji:GimbalRollDegree="+2.5" '
        b'drone-dji:CalibratedFocalLength="3000.0" drone-dji:GimbalYaw',
    )
    stated, sized = {0xA405: 24}, {0xA405: 24, 0xA002: 4000, 0xA003: 3000}
    photo(tmp_path / "stated.jpg", HERE, stated)
    photo(tmp_path / "calibrated.jpg", HERE, sized, xmp=tilted)
    found = {name: record.geotag for name, record in records(tmp_path).items()}
    assert found["stated.jpg"] is not None
    assert (found["stated.jpg"].focal_35mm, found["stated.jpg"].roll_deg) == (24, None)
    assert found["calibrated.jpg"] is not None
    assert found["calibrated.jpg"].focal_35mm == pytest.approx(25.96, abs=0.01)
    assert found["calibrated.jpg"].roll_deg == 2.5


def test_csv_row_tells_roll_and_lens(tmp_path: Path) -> None:
    images(tmp_path, "a/007.jpg")
    text = "path,lat,lon,roll_deg,focal_35mm\na/007.jpg,1,2,-3.5,{}\n"
    record = only(scan(tmp_path / "t.csv", text.format(24)))
    assert record.geotag == GeoTag(lat=1, lon=2, roll_deg=-3.5, focal_35mm=24)
    [refused] = scan(tmp_path / "t.csv", text.format(0))
    assert isinstance(refused, Rejection)
    assert refused.found == "row 1: focal_35mm 0.0, not above 0"
