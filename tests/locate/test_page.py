"""The answer page: one file, silent in a browser, to scale on the map, and safe with hostile
names."""

import io
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.core.geo import haversine_m
from pipeline.core.records import Rejection, View
from pipeline.index.searcher import Hit
from pipeline.locate.fitting.fit_matching import fit_matching
from pipeline.locate.gallery_map import GalleryMap
from pipeline.locate.geojson import LocatedPhoto
from pipeline.locate.locate import Answer, Position
from pipeline.locate.page import (
    MAX_SHOWN,
    PageContext,
    distance_to_m,
    format_distance,
    render_page,
    short_name,
)
from pipeline.locate.page_map import (
    MAP_SIDE_PX,
    MapFrame,
    fit_frame,
    nearby_keys,
    overview_map,
    position_map,
    square_footprint,
    svg_matrix,
)
from tests.locate.calibrations import make_calibration
from tests.locate.test_refined import matched

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser") if (found := shutil.which(name))), None
)
HOSTILE = "<script>alert(1)</script>\"'&-that-does-not-end" * 3
METRE = 1 / 111_195.08


def gallery(lon: float = 8.0) -> GalleryMap:
    """Nine positions 100 m apart around latitude 0."""
    at = [
        (100 * METRE * row, (lon + 100 * METRE * column + 180) % 360 - 180)
        for row in (-1, 0, 1)
        for column in (-1, 0, 1)
    ]
    names = np.array([f"gallery-satellite-{number}" for number in range(9)])
    return GalleryMap(keys=names, locations=names, positions_N2=np.array(at), rows=9)


def answer(known: bool = True, lat: float = 0.0, lon: float = 8.0, location: str = "4") -> Answer:
    hits = [
        Hit(
            key=f"gallery-satellite-{n}",
            location=location if n == 4 else HOSTILE,
            view=View.SATELLITE,
            lat=lat,
            lon=lon,
            score=0.5,
        )
        for n in (4, 5, 8)
    ]
    return Answer(
        position=Position(lat=lat, lon=lon, radius_m=50.0),
        location=location,
        probability=0.75,
        known=known,
        candidates=tuple(hits),
        agreeing=1,
    )


def picture() -> bytes:
    stream = io.BytesIO()
    Image.new("RGB", (120, 120), "olive").save(stream, "JPEG")
    return stream.getvalue()


LOCATED = [
    LocatedPhoto(name="flight/a.jpg", photos=("flight/a.jpg",), answer=answer(), taken_at="10"),
    LocatedPhoto(name=HOSTILE, photos=(HOSTILE,), answer=answer(known=False)),
    LocatedPhoto(
        name="c.jpg",
        photos=("c.jpg",),
        rejected=(Rejection(path="c.jpg", reason="empty file", found=HOSTILE),),
    ),
]


def page(located: list[LocatedPhoto] = LOCATED, **changes: Any) -> str:
    given: dict[str, Any] = {
        "title": "Where?",
        "gallery": gallery(),
        "calibration": None,
        "fingerprint": "f" * 64,
    } | changes
    return render_page(
        located,
        PageContext(**given),
        lambda names: {},
        lambda keys: dict.fromkeys(keys, picture()),
    )


def test_page_says_below_what_probability_it_is_unknown() -> None:
    plain = make_calibration()
    assert "is right is below 40 %:" in page(calibration=plain)
    assert "is right is below 40 %:" in page(calibration=plain, matched=True)
    matching = replace(fit_matching(matched(), plain, within_m=5.0), tile_threshold=0.55)
    of_matches = replace(plain, matching=matching)
    text = page(calibration=of_matches, matched=True)
    assert "is right is below 10 % for a photo" in text
    assert "below 55 % for another" in text
    assert "this answered 100 % of the photos, 100 % of these" in text
    assert "is right is below 40 %:" in page(calibration=of_matches)  # tiles alone


def test_page_shows_known_unknown_and_damaged() -> None:
    text = page(true_positions={"flight/a.jpg": (30 * METRE, 8.0)})
    assert "0.000000, 8.000000" in text
    assert "truly 30 m away" in text
    assert "1 of 3 photos" in re.sub(r"\s+", " ", text)
    assert "Unknown" in text
    assert "empty file" in text


def test_page_escapes_names_and_loads_nothing() -> None:
    text = page()
    assert "<script" not in text
    assert "default-src 'none'" in text
    assert not re.search(r'(?:src|href)="(?!data:|#)', text)


def test_page_contains_each_tile_once() -> None:
    """Nine tiles, however many answers show them."""
    assert page([LOCATED[0]] * 5).count("<image id=") == 9


def test_page_of_many_answers_shows_some() -> None:
    text = page([LOCATED[0]] * (MAX_SHOWN + 20))
    assert text.count('<article class="photo">') == MAX_SHOWN
    assert f"{MAX_SHOWN} of them are shown" in text


def test_map_frame_pixels_by_hand() -> None:
    """100 m north and east of the middle of a map of 400 m: three quarters across, a quarter
    down."""
    frame = MapFrame(lat=60.0, lon=8.0, half_m=200)
    x, y = frame.pixels(np.array([[60 + 100 * METRE, 8 + 200 * METRE]]))[0]
    assert (x, y) == pytest.approx((0.75 * MAP_SIDE_PX, 0.25 * MAP_SIDE_PX), abs=0.1)
    assert frame.length(200) == MAP_SIDE_PX / 2
    assert [MapFrame(lat=0, lon=0, half_m=half).bar_m for half in (200, 3700, 9, 101)] == [
        100,
        1000,
        2,
        50,
    ]


def test_position_map_across_180_degrees() -> None:
    around = gallery(lon=180.0)
    view = position_map(answer(lon=180.0), around, {})
    assert view is not None
    assert len(view.tiles) == 9
    frame = fit_frame(around.positions_N2)
    assert abs(frame.lon) == pytest.approx(180)
    assert frame.half_m < 200


def test_position_map_tiles_by_known_footprints() -> None:
    corners = square_footprint(0.0, 8.0, 40.0)
    turned = (*corners[1:], corners[0])
    view = position_map(answer(), gallery(), {"gallery-satellite-4": turned})
    assert view is not None
    (tile,) = [one for one in view.tiles if one.key == "gallery-satellite-4"]
    assert tile.matrix == svg_matrix(view.frame.pixels(np.array(turned))[[0, 1, 3]])
    a, b, *_ = map(float, tile.matrix.removeprefix("matrix(").removesuffix(")").split())
    assert (a, b) == pytest.approx((0, view.frame.length(40)), abs=0.1)
    assert "gallery-satellite-4" in nearby_keys(answer(), gallery())


def test_square_footprint_side_lengths() -> None:
    corners = np.array(square_footprint(60.0, 8.0, 40.0))
    assert haversine_m(corners, np.roll(corners, -1, axis=0)) == pytest.approx([40] * 4, rel=1e-3)


def test_overview_map_marks_and_line() -> None:
    answers = [("a", answer()), ("b", answer(known=False)), ("c", answer(lat=100 * METRE))]
    view = overview_map(answers, gallery(), track=True)
    assert view is not None
    assert (len(view.dots), len(view.marks), len(view.line.split())) == (9, 2, 2)
    assert (
        position_map(
            Answer(
                position=None, location="a", probability=None, known=True, candidates=(), agreeing=1
            ),
            gallery(),
            {},
        )
        is None
    )


def test_format_distance_and_short_name() -> None:
    assert [format_distance(metres) for metres in (None, 0.2, 99.6, 2345)] == [
        "",
        "here",
        "100 m away",
        "2.3 km away",
    ]
    assert distance_to_m(answer(), None) is None
    assert short_name("/long/way/0001/image.jpg") == "0001/image.jpg"


@pytest.mark.slow
@pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium on this machine: apt-get install chromium"
)
def test_page_in_a_browser_is_silent_and_fits(tmp_path: Path) -> None:
    sync_api = pytest.importorskip(
        "playwright.sync_api", reason="needs Playwright: install the project with [dev]"
    )
    (tmp_path / "page.html").write_text(page())
    address = (tmp_path / "page.html").as_uri()
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM,
            args=["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"],
        )
        for width, scheme in ((375, "dark"), (1300, "light")):
            tab = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme)
            messages: list[str] = []
            urls: list[str] = []
            tab.on("console", lambda message, messages=messages: messages.append(message.text))
            tab.on("request", lambda request, urls=urls: urls.append(request.url))
            tab.goto(address)
            assert messages == []
            assert [url for url in urls if not url.startswith("data:")] == [address]
            assert tab.evaluate("document.documentElement.scrollWidth") <= width
            assert tab.locator("svg use").first.bounding_box()["width"] > 10
        browser.close()
