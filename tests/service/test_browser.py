"""The service's page in a real browser: a photo dropped, chosen or pasted; by keyboard, small,
dark."""

import asyncio
import base64
import io
import threading
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from aiohttp import web
from PIL import Image

from pipeline.core.arrays import Pixels
from pipeline.images.camera_tags import CameraTags
from pipeline.matching.photo_pose import PoseSettings
from pipeline.service.app import Service
from pipeline.service.photo_map import PictureRequest
from pipeline.service.settings import ServiceSettings
from tests.matching.made_maps import made_map, photo_of, window_of
from tests.report.test_browser import ARGUMENTS, CHROMIUM, sync_api
from tests.service.http_client import TOKEN, FakeEngine
from tests.service.photos import photo
from tests.service.test_photo_map import ServedMap

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium on this machine: apt-get install chromium"
)
DROP = """([name, kind, data]) => {
    const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
    const dropped = new DataTransfer();
    dropped.items.add(new File([bytes], name, { type: kind }));
    const how = { bubbles: true, cancelable: true };
    const event = new DragEvent('drop', { dataTransfer: dropped, ...how });
    document.querySelector('#drop').dispatchEvent(event);
}"""
PASTE = DROP.replace(
    "DragEvent('drop', { dataTransfer:", "ClipboardEvent('paste', { clipboardData:"
)


class Served:
    """A service in a thread of its own."""

    def __init__(self, token: str | None = None, engine: FakeEngine | None = None) -> None:
        self._loop = asyncio.new_event_loop()
        self.engine = engine or FakeEngine()
        self._runner = Service(ServiceSettings(max_megabytes=1), self.engine, token).runner()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        port = asyncio.run_coroutine_threadsafe(self._start(), self._loop).result(10)
        self.address = f"http://127.0.0.1:{port}/"

    async def _start(self) -> int:
        await self._runner.setup()
        site = web.TCPSite(self._runner, "127.0.0.1", 0)
        await site.start()
        return site.port

    def stop(self) -> None:
        asyncio.run_coroutine_threadsafe(self._runner.cleanup(), self._loop).result(10)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    service = Served()
    yield service
    service.stop()


@pytest.fixture
def page(browser: Any, served: Served) -> Iterator[Any]:
    """The page; afterwards its console is empty and it has made no request to another host."""
    opened = browser.new_page()
    messages: list[str] = []
    urls: list[str] = []
    opened.on("console", lambda message: messages.append(message.text))
    opened.on("pageerror", lambda error: messages.append(str(error)))
    opened.on("request", lambda request: urls.append(request.url))
    opened.goto(served.address)
    yield opened
    opened.close()
    assert messages == []
    assert all(url.startswith((served.address, f"blob:{served.address}")) for url in urls), urls


def give(
    page: Any, how: str, data: bytes, name: str = "photo.jpg", kind: str = "image/jpeg"
) -> None:
    page.evaluate(how, [name, kind, base64.b64encode(data).decode()])


def test_page_dropped_photo_shows_answer_and_map(
    page: Any,
) -> None:
    give(page, DROP, photo())
    page.wait_for_selector("#answer:not([hidden])")
    assert page.inner_text("#position") == "47.000000, 8.000000"
    assert page.inner_text("#radius") == "± 25 m"
    assert page.inner_text("#confidence") == "80 %"
    assert page.inner_text("#say").startswith("Found in")
    cards = page.locator("#candidates li")
    assert cards.count() == 5
    assert cards.nth(1).inner_text().split() == ["2", "0001", "0.890", "111", "m", "away"]
    assert cards.nth(1).get_attribute("title") == "gallery-1"
    assert page.locator("#candidates img").count() == 0  # this service has no pixels
    assert not page.is_visible("#controls label")
    assert page.locator("#map circle.dot").count() == 5
    assert page.locator("#map circle.dot.best").count() == 1
    assert page.evaluate("document.querySelector('#preview').naturalWidth") == 40
    assert "3 images in the gallery" in page.inner_text("#index")


def test_page_map_is_to_scale(page: Any) -> None:
    """Candidates are 0.001 degrees of latitude apart, 111.2 m; the scale bar gives the length of
    about 100 m."""
    give(page, DROP, photo())
    page.wait_for_selector("#answer:not([hidden])")
    y = sorted(float(dot.get_attribute("cy")) for dot in page.locator("#map circle.dot").all())
    apart = [below - above for above, below in pairwise(y)]
    x = [float(page.locator("#map .rule").get_attribute(end)) for end in ("x1", "x2")]
    rule = float(page.locator("#map text:not(.rank)").first.text_content().split()[0])
    assert apart == pytest.approx([111.195 * (x[1] - x[0]) / rule] * 4, rel=1e-3)


def test_page_shows_error_sentence(browser: Any, served: Served) -> None:
    page = browser.new_page()  # Chromium notes each refused request on the console
    page.goto(served.address)
    for data, kind, word in (
        (b"<svg/>", "image/svg+xml", "expected a JPEG"),
        (bytes(2_000_000), "image/jpeg", "larger than 1 MB"),
    ):
        give(page, DROP, data, kind=kind)
        page.wait_for_function(
            "word => document.querySelector('#say').textContent.includes(word)", arg=word
        )
        assert "error" in page.locator("#say").get_attribute("class")
        assert not page.is_visible("#answer")
    give(page, PASTE, photo("PNG"), "photo.png", "image/png")
    page.wait_for_selector("#answer:not([hidden])")
    page.close()


def test_page_fields_by_keyboard(page: Any, served: Served) -> None:
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.id") == "photo"
    page.set_input_files("#photo", {"name": "a.jpg", "mimeType": "image/jpeg", "buffer": photo()})
    page.wait_for_selector("#answer:not([hidden])")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    for text in ("47,5", "8.5", "2000", "3"):
        page.keyboard.press("Tab")
        page.keyboard.type(text)
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    for text in ("80", "73,7", "12", "-60"):
        page.keyboard.press("Tab")
        page.keyboard.type(text)
    page.keyboard.press("Enter")
    page.wait_for_function("() => document.querySelectorAll('#candidates li').length === 3")
    question = served.engine.batches[-1][0]
    assert question.near is not None
    assert (question.near.lat, question.near.lon, question.near.radius_m, question.top) == (
        47.5,
        8.5,
        2000,
        3,
    )
    assert question.pose == PoseSettings(height=80, fov=73.7, heading=12, pitch=-60)
    assert page.locator("#map circle.near").count() == 1


class MatchingEngine(FakeEngine):
    """Matches every photo with a made map."""

    def __init__(self) -> None:
        made = ServedMap()
        self.photo_map = made.photo_map()
        framed = self.photo_map.frame(map_photo(), CameraTags(), PoseSettings(fov=55))
        super().__init__(self.photo_map.refine(made.tile_answer(), framed))

    async def picture(self, wanted: PictureRequest) -> bytes | None:
        return self.photo_map.picture(wanted)


def map_photo() -> Pixels:
    return photo_of(window_of(made_map(0)))


@pytest.fixture
def matching() -> Iterator[Served]:
    """A service that matches photos with the map."""
    service = Served(engine=MatchingEngine())
    yield service
    service.stop()


@pytest.mark.parametrize("width", [390, 1280])
def test_page_lays_photo_over_map_where_it_belongs(
    browser: Any, matching: Served, width: int
) -> None:
    """With the photo laid over it, the map looks as it does without it."""
    page = browser.new_page(viewport={"width": width, "height": 900})
    page.goto(matching.address)
    stream = io.BytesIO()
    Image.fromarray(map_photo()).save(stream, "PNG")
    give(page, DROP, stream.getvalue(), "photo.png", "image/png")
    page.wait_for_selector("#stage.over")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate("document.querySelector('#candidates img').naturalWidth") > 0
    assert "points within" in page.inner_text("#matches")
    assert page.inner_text("#heading-found") == "30°"
    page.uncheck("#with-matches")
    shots = []
    for opacity in (0, 100):
        page.evaluate(
            "opacity => { $('opacity').value = opacity; "
            "$('opacity').dispatchEvent(new Event('input')); }", opacity
        )  # fmt: skip
        shot = Image.open(io.BytesIO(page.locator("#stage").screenshot())).convert("L")
        shots.append(np.asarray(shot, np.float64))
    changed_HW = np.abs(shots[1] - shots[0]) > 3
    assert changed_HW.mean() > 0.1
    alike = np.corrcoef(shots[0][changed_HW], shots[1][changed_HW])[0, 1]
    page.close()
    assert alike > 0.9


@pytest.mark.parametrize(
    ("width", "scheme"), [(360, "light"), (768, "dark"), (1280, "light"), (1280, "dark")]
)
def test_pages_fit_every_width_and_scheme(
    browser: Any, served: Served, width: int, scheme: str
) -> None:
    page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme)
    page.goto(served.address)
    give(page, DROP, photo(size=(900, 700)), "a-name-that-does-not-end-" * 9 + ".jpg")
    page.wait_for_selector("#answer:not([hidden])")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(20, 23, 26)"
    assert dark == (scheme == "dark")
    page.goto(f"{served.address}api")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.locator("section.call").count() == 5 + 9  # paths, schemas
    page.close()


def test_page_asks_for_required_token(browser: Any) -> None:
    service = Served(TOKEN)
    page = browser.new_page()
    page.goto(service.address)
    give(page, DROP, photo())
    page.wait_for_selector("#token-field:not([hidden])")
    assert page.evaluate("document.activeElement.id") == "token"
    page.keyboard.type(TOKEN)
    page.keyboard.press("Enter")
    page.wait_for_selector("#answer:not([hidden])")
    page.close()
    service.stop()
