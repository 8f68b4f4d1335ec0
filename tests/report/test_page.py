"""The report page as text: what it shows, which queries it chooses, and that it escapes names."""

import io
import json
import re
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from PIL import Image

from pipeline.core.errors import InputError
from pipeline.images.thumbnails import ThumbnailCache, no_images, thumbnail
from pipeline.report import page as report
from pipeline.report.inputs import EvaluationResults, ReportContext, read_training
from pipeline.report.panels import (
    confidence_order,
    error_order,
    make_panel,
    panel_keys,
    spread_over_locations,
)
from pipeline.retrieval.geo_metrics import WITH_INTERVALS
from pipeline.retrieval.tasks import RESULTS_SCHEMA


def result(
    location: str, first: int | None, score: float = 0.9, task: str = "drone->satellite"
) -> dict[str, Any]:
    """A query whose true match has this rank among ten."""
    tops = [location if rank == first else f"other{rank}" for rank in range(1, 11)]
    return {
        "query": f"query-drone-{location}-{score}",
        "location": location,
        "task": task,
        "protocol": "full",
        "multi_query": False,
        "matches": 0 if first is None else 1,
        "first_match_rank": first,
        "first_match_key": first and f"gallery-{location}",
        "first_match_score": first and score - 0.01 * first,
        "ap": 0.0,
        "top_keys": [f"gallery-{place}" for place in tops],
        "top_scores": [score - 0.01 * rank for rank in range(1, 11)],
        "top_locations": tops,
    }


def evaluation(rows: list[dict[str, Any]], name: str = "out", r1: float = 0.5) -> EvaluationResults:
    metrics = {
        "task": "drone->satellite",
        "protocol": "full",
        "multi_query": False,
        "queries": len(rows),
        "gallery": 951,
        "r1": r1,
        "r5": 0.75,
        "r10": 0.8,
        "r1p": 0.8,
        "ap": 0.625,
        "fingerprint": "abcdef0123456789" * 4,
    }
    return EvaluationResults(
        name=name, metrics=[metrics], results=pa.Table.from_pylist(rows, RESULTS_SCHEMA)
    )


def jpeg(colour: str, size: tuple[int, int] = (400, 300)) -> bytes:
    stream = io.BytesIO()
    Image.new("RGB", size, colour).save(stream, "JPEG")
    return stream.getvalue()


TOWN = [result("0001", 1), result("0002", 3), result("0003", 40), result("0004", None)]


def page(rows: list[dict[str, Any]] = TOWN, extras: ReportContext | None = None) -> str:
    pictures = {key: jpeg("olive") for key in panel_keys(rows)}
    return report.render_report(
        evaluation(rows),
        extras or ReportContext(title="Town"),
        lambda keys: {key: pictures[key] for key in keys},
    )


def test_page_shows_measures_in_percent_and_chance() -> None:
    text = page()
    assert all(
        figure in text
        for figure in ("50.00", "75.00", "62.50", "R@11 of 951", f"{100 * 3 / 4 / 951:.2f}")
    )
    assert "1 queries have no true match and count as missed" in text


def test_page_of_the_same_results_is_the_same() -> None:
    assert page() == page()


def test_page_frames_and_names_right_and_wrong_answers() -> None:
    text = page()
    # Ranks 1 and 3, and the true match at rank 40, which is shown apart.
    assert len(re.findall(r'class="answer right ', text)) == 3
    assert len(re.findall(r'class="answer wrong ', text)) == 4 * 5 - 2
    assert 'alt="Rank 1, location 0001, a true match"' in text
    assert "first true match at rank&nbsp;40" in text
    assert "no true match in the gallery" in text


def test_make_panel_adds_the_true_match_outside_the_top_five() -> None:
    panel = make_panel(TOWN[2], ThumbnailCache({}))
    assert panel.truth
    assert (panel.truth.rank, panel.truth.key, panel.truth.right) == (40, "gallery-0003", True)
    assert make_panel(TOWN[1], ThumbnailCache({})).truth is None


def test_page_escapes_hostile_names() -> None:
    evil = "<script>alert(1)</script>\"'"
    text = page(
        [result(evil, 1), result(evil, 2, 0.8)],
        ReportContext(title=evil, training=({"epoch": 1, "location_loss": 1.0},)),
    )
    assert "<script" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text


def test_page_loads_nothing() -> None:
    text = page()
    assert "default-src 'none'" in text
    assert not re.search(r'(?:src|href)="(?!data:|#)', text)
    assert "url(" not in text
    assert "@import" not in text


def test_page_without_images_says_how_to_get_them() -> None:
    text = report.render_report(evaluation(TOWN), ReportContext(title="Town"), no_images)
    assert "evaluate again with <code>--shards</code>" in text
    assert "<img" not in text


def test_page_compares_with_another_evaluation() -> None:
    text = page(
        extras=ReportContext(title="Town", beside=evaluation(TOWN, name="untrained", r1=0.125))
    )
    assert "12.50" in text
    assert "+37.50" in text
    assert "untrained" in text


def test_page_refuses_to_compare_with_other_images() -> None:
    with pytest.raises(
        InputError, match=r"untrained ranked 3 queries in 951 rows .* this evaluation 4 in 951"
    ):
        page(extras=ReportContext(title="Town", beside=evaluation(TOWN[:3], name="untrained")))


def test_page_without_hits_or_misses_says_so() -> None:
    assert "No query has a true match first." in page(TOWN[1:])
    assert "Every query has a true match first." in page(TOWN[:1])


def test_spread_covers_the_range_and_many_locations() -> None:
    rows = [result(f"{i % 10:04d}", 1, 0.5 + 0.001 * i) for i in range(100)]
    chosen = spread_over_locations(rows, 4, confidence_order)
    assert [row["location"] for row in chosen] == ["0009", "0006", "0003", "0000"]
    assert chosen == spread_over_locations(rows[::-1], 4, confidence_order)
    assert [row["first_match_rank"] for row in spread_over_locations(TOWN, 3, error_order)] == [
        None,
        3,
        1,
    ]
    assert len(spread_over_locations(rows[:2], 4, confidence_order)) == 2
    assert (
        len(
            spread_over_locations(
                [result("0001", 1, 0.1 * i) for i in range(1, 9)], 4, confidence_order
            )
        )
        == 4
    )


def test_thumbnail_is_small_and_none_if_damaged() -> None:
    source = thumbnail(jpeg("teal", (900, 450)), 180)
    assert source
    assert source.startswith("data:image/webp;base64,")
    assert len(source) < 4000
    assert thumbnail(b"damaged", 180) is None
    assert thumbnail(None, 180) is None


def write_lines(run: Path, *lines: str) -> str:
    (run / "metrics.jsonl").write_text("\n".join(lines))
    return str(run)


def test_read_training_keeps_the_later_row_of_an_epoch(tmp_path: Path) -> None:
    lines = [
        json.dumps({"epoch": epoch, "alpha": alpha})
        for epoch, alpha in ((1, 0.9), (2, 0.9), (2, 1.0), (3, 1.0))
    ]
    assert [
        row["alpha"] for row in read_training(write_lines(tmp_path, *lines, '{"epoch": 4, "al'))
    ] == [0.9, 1.0, 1.0]


def test_read_training_refuses_other_content(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"found no metrics.jsonl"):
        read_training(str(tmp_path))
    with pytest.raises(InputError, match=r"line 1 of .* expected a JSON object with its epoch"):
        read_training(write_lines(tmp_path, "[]", '{"epoch": 1}'))


INTERVALS = {"r1_low": 0.4, "r1_high": 0.6, "ap_low": 0.5, "ap_high": 0.75}
CURVE = tuple(
    {
        "task": "drone->satellite",
        "views": n,
        "queries": 54 // n,
        "r1": n / 54,
        "r1_low": n / 60,
        "r1_high": n / 54,
    }
    for n in (1, 6, 54)
)


def test_page_shows_intervals_distances_and_views() -> None:
    geo = {
        "geo_queries": 4,
        "distance_median_m": 12.4,
        "distance_p90_m": 40.0,
        "within_1m": 0.0,
        "within_5m": 0.25,
        **{f"{name}_{end}": 0.125 for name in WITH_INTERVALS for end in ("low", "high")},
        "within_25m": 0.5,
        "within_50m": 0.75,
        "within_100m": 1.0,
    }
    plain = evaluation(TOWN)
    full = EvaluationResults(
        name="out", metrics=[plain.metrics[0] | INTERVALS | geo], results=plain.results, views=CURVE
    )
    text = report.render_report(full, ReportContext(title="Town"), lambda keys: {})
    assert "40.0 to 60.0" in text
    assert "best answer off by 12 m (median); within 1, 5, 25 m: 0.00, 25.00, 50.00" in text
    assert "Errors in metres" in text
    assert "12.5 to 12.5" in text
    assert "≤ 5 m" in text
    assert "R@1 by views a query: 1 views: 1.85 %, 6 views: 11.11 %, 54 views: 100.00 %" in text
    assert "median score" in text
    before = report.render_report(plain, ReportContext(title="Town"), lambda keys: {})
    assert "R@1 by views" not in before
    assert "95 % interval" not in before
