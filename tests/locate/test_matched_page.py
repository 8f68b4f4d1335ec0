"""Matched photos on the answer page: laid over the map where they belong, with the pairs that carry
them."""

import base64
import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.camera.warp import lay_on
from pipeline.images.camera_tags import CameraTags
from pipeline.locate.geojson import LocatedPhoto
from pipeline.locate.page import PageContext, render_page
from pipeline.locate.page_map import MAP_SIDE_PX, MapFrame, match_paths, photo_box
from pipeline.matching.refine import MatchedPoint, Refinement
from pipeline.service.request import NOTHING_KNOWN
from tests.locate.test_page import CHROMIUM, METRE
from tests.matching.made_maps import made_map, photo_of, window_of
from tests.service.test_photo_map import ServedMap

pytestmark = pytest.mark.slow

MOST_BYTES = 200_000
"Of a photo on the page: of noise, which WebP packs worst."


def as_jpeg(pixels: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "JPEG", quality=95)
    return stream.getvalue()


@pytest.fixture(scope="module")
def located() -> tuple[ServedMap, LocatedPhoto]:
    made = ServedMap()
    photo_map = made.photo_map()
    framed = photo_map.frame(photo_of(window_of(made_map(0))), CameraTags(), NOTHING_KNOWN)
    answer = photo_map.refine(made.tile_answer(), framed).answer
    return made, LocatedPhoto(name="a.jpg", photos=("a.jpg",), answer=answer)


def page_of(made: ServedMap, *shown: LocatedPhoto, photo: bytes | None = None) -> str:
    context = PageContext(
        title="Where?", gallery=made.gallery, calibration=None, fingerprint="f" * 64,
        footprints=made.footprints,
    )  # fmt: skip
    data = photo or as_jpeg(photo_of(window_of(made_map(0))))
    return render_page(shown, context, lambda names: dict.fromkeys(names, data), made.fetch)


def refinement_of(one: LocatedPhoto) -> Refinement:
    assert one.answer is not None
    assert one.answer.refinement is not None
    return one.answer.refinement


def test_lay_on_puts_corners_where_they_are_said_to_lie() -> None:
    image_HW3 = np.zeros((30, 40, 3), np.uint8)
    image_HW3[:15, :20] = (255, 0, 0)
    target_42 = np.array([[60, 10], [60, 50], [30, 50], [30, 10]], np.float64)  # a quarter turn
    laid_HW4 = lay_on(image_HW3, target_42, (80, 70))
    assert laid_HW4.shape == (70, 80, 4)
    assert laid_HW4[20, 55].tolist() == [255, 0, 0, 255]
    assert laid_HW4[40, 55].tolist() == [0, 0, 0, 255]
    assert laid_HW4[20, 35].tolist() == [0, 0, 0, 255]
    assert laid_HW4[20, 70, 3] == laid_HW4[60, 40, 3] == 0


def test_match_paths_by_hand(located: tuple[ServedMap, LocatedPhoto]) -> None:
    point = MatchedPoint(x=0.25, y=0.5, lat=50 * METRE, lon=8.0)
    refinement = replace(refinement_of(located[1]), points=(point,))
    frame = MapFrame(lat=0.0, lon=8.0, half_m=100)
    box = photo_box((400, 200), 0, 0)
    assert box == (0, MAP_SIDE_PX / 4, MAP_SIDE_PX, MAP_SIDE_PX / 2)
    lines, ends = match_paths(refinement, frame, box, (336.0, 0.0))
    assert lines == "M80.0 160.0L496.0 80.0"
    assert ends == "M80.0 160.0h0M496.0 80.0h0"


def test_page_lays_matched_photo_over_the_map(located: tuple[ServedMap, LocatedPhoto]) -> None:
    """The laid photo looks like the map at its place."""
    made, one = located
    text = page_of(made, one)
    found = re.search(
        r'<image id="laid-1" href="data:image/webp;base64,([^"]+)" '
        r'x="([^"]+)" y="([^"]+)" width="([^"]+)" height="([^"]+)"', text
    )  # fmt: skip
    assert found is not None
    x, y, width, height = (float(number) for number in found.groups()[1:])
    laid = Image.open(io.BytesIO(base64.b64decode(found[1]))).resize((round(width), round(height)))
    laid_HW4 = np.asarray(laid, np.float64)
    frame = re.search(r"Map of (\d+) m around", text)
    assert frame is not None
    scale = MAP_SIDE_PX / float(frame[1])  # pixels of the page per metre of the map
    refinement = refinement_of(one)
    window = window_of(made_map(0))
    [[east, north]] = window.plane.to_metres(np.array([[refinement.lat, refinement.lon]]))
    middle_2 = np.array([len(window.pixels_HW3) / 2] * 2) + np.array([east, -north]) / 0.3
    half = MAP_SIDE_PX / 2 / scale / 0.3
    box = (*(middle_2 - half).tolist(), *(middle_2 + half).tolist())
    shown = Image.fromarray(window.pixels_HW3).crop(tuple(round(edge) for edge in box))
    map_HW3 = np.asarray(shown.resize((MAP_SIDE_PX, MAP_SIDE_PX)), np.float64)
    under_HW3 = map_HW3[round(y) :, round(x) :][: laid_HW4.shape[0], : laid_HW4.shape[1]]
    inside_HW = laid_HW4[:, :, 3] > 250
    assert inside_HW.mean() > 0.3
    alike = np.corrcoef(laid_HW4[:, :, 0][inside_HW], under_HW3[:, :, 0][inside_HW])[0, 1]
    assert alike > 0.8


def test_page_of_matched_photos_stays_light(located: tuple[ServedMap, LocatedPhoto]) -> None:
    made, one = located
    noise = np.random.default_rng(0).integers(0, 256, (900, 1200, 3), dtype=np.uint8)
    once = len(page_of(made, one, photo=as_jpeg(noise)))
    assert len(page_of(made, *[one] * 4, photo=as_jpeg(noise))) - once < 3 * MOST_BYTES
    assert page_of(made, one).count('class="link"') == 2  # for wide and for narrow screens


def test_page_of_unreadable_photo_shows_the_map_alone(
    located: tuple[ServedMap, LocatedPhoto],
) -> None:
    text = page_of(*located, photo=b"no image")
    assert "laid-1" not in text
    assert "no picture" in text
    assert "Around it" in text


@pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium on this machine: apt-get install chromium"
)
@pytest.mark.parametrize(("width", "scheme"), [(390, "dark"), (1280, "light")])
def test_page_switches_photos_and_matches(
    located: tuple[ServedMap, LocatedPhoto], tmp_path: Path, width: int, scheme: str
) -> None:
    sync_api = pytest.importorskip(
        "playwright.sync_api", reason="needs Playwright: install the project with [dev]"
    )
    (tmp_path / "page.html").write_text(page_of(*located))
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM,
            args=["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"],
        )
        tab = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
        messages: list[str] = []
        tab.on("console", lambda message: messages.append(message.text))
        tab.goto((tmp_path / "page.html").as_uri())
        assert tab.evaluate("document.documentElement.scrollWidth") <= width
        shown = tab.locator("svg.pair:visible")
        assert shown.count() == 1
        laid = shown.locator(".laid")
        assert laid.evaluate("element => getComputedStyle(element).opacity") == "1"
        tab.check("#laid-none")
        assert laid.evaluate("element => getComputedStyle(element).opacity") == "0"
        assert shown.locator(".link").is_visible()
        tab.uncheck("#with-links")
        assert not shown.locator(".link").is_visible()
        assert messages == []
        browser.close()
