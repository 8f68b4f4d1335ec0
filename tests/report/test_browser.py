"""The report in a real browser: no console message, no request, and a layout that fits a phone."""

import io
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from PIL import Image

from pipeline.report import page as report
from pipeline.report.inputs import EvaluationResults, ReportContext
from pipeline.retrieval.geo_metrics import WITH_INTERVALS
from pipeline.retrieval.tasks import RESULTS_SCHEMA
from tests.report.test_sections import GAP, GROUPS, PARTS

sync_api = pytest.importorskip(
    "playwright.sync_api", reason="needs Playwright: install the project with [dev]"
)
CHROMIUM = next(
    (
        found
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (found := shutil.which(name))
    ),
    None,
)
ARGUMENTS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium on this machine: apt-get install chromium"
)

LONG = "a-location-with-a-name-that-does-not-end-" * 4


def result(location: str, first: int | None, multi: bool = False) -> dict[str, Any]:
    """A query whose true match has this rank; `multi`: all images of a place as one query."""
    tops = [location if rank == first else f"other{rank}" for rank in range(1, 6)]
    return {
        "query": location if multi else f"query-{location}",
        "location": location,
        "task": "drone->satellite",
        "protocol": "full",
        "multi_query": multi,
        "lat": 30.0,
        "lon": 120.0,
        "answer_lat": 30.1,
        "answer_lon": 120.1,
        "distance_m": 14_700.0,
        "matches": int(first is not None),
        "first_match_rank": first,
        "first_match_key": first and "gallery-true",
        "first_match_score": first and 0.1,
        "ap": 0.0,
        "top_keys": tops,
        "top_scores": [0.9, 0.8, 0.7, 0.6, 0.5],
        "top_locations": tops,
    }


def evaluation(rows: list[dict[str, Any]], name: str) -> EvaluationResults:
    counts = {
        "task": "drone->satellite",
        "protocol": "full",
        "multi_query": False,
        "queries": len(rows),
        "gallery": 51_355,
    }
    metrics = (
        counts | dict.fromkeys(("r1", "r5", "r10", "r1p", "ap"), 1.0) | {"fingerprint": "f" * 64}
    )
    metrics |= {f"{measure}_{end}": 0.5 for measure in ("r1", "ap") for end in ("low", "high")}
    metrics |= {
        "geo_queries": 5,
        "distance_median_m": 1234.5,
        "distance_p90_m": 40.0,
        "within_1m": 0.0,
        "within_5m": 0.25,
        **{f"{name}_{end}": 0.125 for name in WITH_INTERVALS for end in ("low", "high")},
        "within_25m": 0.5,
        "within_50m": 0.5,
        "within_100m": 1.0,
    }
    views = tuple(
        {
            "task": "drone->satellite",
            "views": n,
            "queries": 54 // n,
            "r1": 0.5,
            "r1_low": 0.25,
            "r1_high": 0.75,
        }
        for n in (1, 2, 3, 6, 9, 18, 27, 54)
    )
    groups = tuple(GROUPS[0] | {"value": value} for value in (LONG, "50 to 100"))
    merged = [result(row["location"], 1, multi=True) for row in rows]
    of_merged = metrics | {"multi_query": True, "queries": len(merged), "geo_queries": 0}
    return EvaluationResults(
        name=name,
        metrics=[metrics, of_merged],
        views=views,
        groups=groups,
        parts=PARTS,
        gaps=(GAP,),
        results=pa.Table.from_pylist([*rows, *merged], RESULTS_SCHEMA),
    )


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A page with every section, and a name of 160 characters."""
    stream = io.BytesIO()
    Image.new("RGB", (300, 300), "olive").save(stream, "JPEG")
    rows = [
        result("0001", 1),
        result(LONG, 1),
        result("0002", 3),
        result(LONG, 12_345),
        result("0004", None),
    ]
    rows += [result(f"1{number:03d}", 1) for number in range(9)]
    training = tuple(
        {"epoch": e, "location_loss": 9 / e, "view_loss": 0.7, "alpha": 0.9 + e // 5}
        for e in range(1, 9)
    )
    extras = ReportContext(title="A town", beside=evaluation(rows, LONG), training=training)
    path: Path = tmp_path_factory.mktemp("page") / "report.html"
    vector = np.full(4, 0.5, np.float32)
    path.write_text(report.render_report(
        evaluation(rows, "out"), extras, lambda keys: dict.fromkeys(keys, stream.getvalue()),
        lambda keys: dict.fromkeys(keys, vector), panels=12,
    ))  # fmt: skip
    return path.as_uri()


@pytest.mark.parametrize(
    ("width", "scheme"), [(375, "light"), (768, "light"), (1024, "dark"), (1600, "dark")]
)
def test_page_fits_without_messages_or_requests(
    browser: Any, address: str, width: int, scheme: str
) -> None:
    page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme)
    messages: list[str] = []
    requests: list[str] = []
    page.on("console", lambda message: messages.append(message.text))
    page.on("pageerror", lambda error: messages.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(address)
    page.evaluate("document.querySelectorAll('details').forEach(each => each.open = true)")
    page.evaluate("document.querySelectorAll('img').forEach(image => image.loading = 'eager')")
    page.wait_for_function(
        "[...document.images].every(image => image.complete && image.naturalWidth > 0)"
    )
    assert messages == []
    assert [url for url in requests if not url.startswith("data:")] == [address]
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    outside = """[...document.querySelectorAll('table, .panel *, .tile *, .chart *')].filter(e => {
        const box = e.getBoundingClientRect();
        return box.width && box.right > innerWidth + 0.5 }).length"""
    assert page.evaluate(outside) == 0
    page.close()


def test_page_frames_true_matches_green_and_wrong_ones_red(browser: Any, address: str) -> None:
    page = browser.new_page()
    page.goto(address)
    colours = {
        kind: set(
            page.eval_on_selector_all(
                f".answer.{kind} .frame", "all => all.map(e => getComputedStyle(e).borderTopColor)"
            )
        )
        for kind in ("right", "wrong")
    }
    assert colours == {"right": {"rgb(22, 128, 60)"}, "wrong": {"rgb(200, 50, 43)"}}
    assert set(page.locator(".answer.right .badge").all_text_contents()) == {"✓"}
    assert set(page.locator(".answer.wrong .badge").all_text_contents()) == {"✗"}
    assert page.locator("img:not([alt])").count() == 0
    page.close()


def test_page_sections_and_panels_are_reached_by_keyboard(browser: Any, address: str) -> None:
    page = browser.new_page(reduced_motion="reduce")  # smooth scrolling takes time
    page.goto(address)
    focused = "document.activeElement.getAttribute('href') || document.activeElement.tagName"
    page.keyboard.press("Tab")
    assert page.evaluate(focused) == "#main"  # past the list of sections
    page.keyboard.press("Tab")
    assert page.evaluate(focused) == "#measures"
    page.keyboard.press("Enter")
    # The browser follows the link, and scrolls below, in its own time.
    page.wait_for_url("**#measures")
    # Of eleven hits six are open, from the first to the last; the others unfold.
    for number in (1, 3, 5, 7, 9, 11):
        page.locator(f"a[href='#drone-satellite-hit-{number}']").focus()
        page.keyboard.press("Tab")
    assert page.evaluate(focused) == "SUMMARY"
    page.keyboard.press("Enter")
    page.wait_for_selector("a[href='#drone-satellite-hit-2']", state="visible")
    page.keyboard.press("Tab")
    assert page.evaluate(focused) == "#drone-satellite-hit-2"
    page.wait_for_function(
        "(({top, bottom}) => 0 <= top && top < bottom && bottom <= innerHeight)"
        "(document.activeElement.getBoundingClientRect())"
    )
    page.close()


def test_page_in_print_shows_all_open_panels(browser: Any, address: str) -> None:
    page = browser.new_page()
    page.goto(address)
    page.emulate_media(media="print")
    assert not page.locator("nav").is_visible()
    assert not page.locator("summary").first.is_visible()
    assert (
        page.locator("#drone-satellite-hit-11").evaluate(
            "each => getComputedStyle(each).contentVisibility"
        )
        == "visible"
    )
    assert page.pdf(format="A4").startswith(b"%PDF")
    page.close()
