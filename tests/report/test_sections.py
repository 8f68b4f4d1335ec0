"""Sections of the page beside the measures: groups, parts, the view gap, and single images compared
with all images of their place."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.report import page as report
from pipeline.report.charts import scatter
from pipeline.report.inputs import EvaluationResults, ReportContext
from pipeline.report.svg import SCATTER_HEIGHT, SCATTER_WIDTH, layout_scatter
from pipeline.report.tables import group_tables, part_tables
from pipeline.report.tasks import pair_queries
from pipeline.retrieval.tasks import RESULTS_SCHEMA
from tests.report.test_page import TOWN, evaluation, jpeg, result

TASK = "drone->satellite"
INTERVALS: dict[str, Any] = {"r1_low": 0.25, "r1_high": 0.75, "ap": 0.5, "queries": 4}
GROUPS = tuple(
    {"task": TASK, "by": "altitude_m", "value": v, "r1": 0.5} | INTERVALS
    for v in ("50 to 100", "100 to 150")
)
PARTS = tuple(
    {"task": TASK, "parts": 2, "part": p, "kept": "alone", "r1": p / 4} | INTERVALS for p in (1, 2)
)
GAP = {
    "task": TASK,
    "shares": [0.5, 0.25],
    "distance": 0.125,
    "joined": [[0, 2]],
    "true": {"pairs": 2, "mean": 0.75, "low": 0.5, "high": 1.0},
    "other": {"pairs": 1, "mean": 0.1, "low": 0.1, "high": 0.1},
    "points": [
        {"key": str(i), "location": "a", "side": side, "x": x, "y": y}
        for i, (side, x, y) in enumerate([("query", -2, 0), ("query", 2, 1), ("gallery", 0, -1)])
    ],
}


def merged(location: str, first: int | None) -> dict[str, Any]:
    """All queries of a place as one."""
    return result(location, first) | {"query": location, "multi_query": True}


def full(single: list[dict[str, Any]], multi: list[dict[str, Any]]) -> EvaluationResults:
    plain = evaluation(single)
    metrics = [plain.metrics[0], plain.metrics[0] | {"multi_query": True, "queries": len(multi)}]
    return replace(
        plain,
        metrics=metrics,
        results=pa.Table.from_pylist([*single, *multi], RESULTS_SCHEMA),
        groups=GROUPS,
        parts=PARTS,
        gaps=(GAP,),
    )


def test_page_has_only_sections_with_data() -> None:
    multi = [merged(row["location"], 1) for row in TOWN]
    text = report.render_report(
        full(TOWN, multi),
        ReportContext(title="Town"),
        lambda keys: dict.fromkeys(keys, jpeg("olive")),
    )
    anchors = set(re.findall(r'<a href="#([^"]+)">', text))
    assert {"groups", "parts", "gap", "drone-satellite-pairs"} <= anchors
    assert anchors <= set(re.findall(r' id="([^"]+)"', text))
    plain = report.render_report(evaluation(TOWN), ReportContext(title="Town"), lambda keys: {})
    assert not {"groups", "parts", "gap", "map", "drone-satellite-pairs"} & set(
        re.findall(r'<section id="([^"]+)"', plain)
    )


def test_panel_answers_show_the_cosine_of_each_part() -> None:
    # The first of two parts equals that of every answer, the second is orthogonal to it.
    of_query, of_answer = (
        np.array(vector, np.float32) / np.float32(np.sqrt(2))
        for vector in ([1, 0, 0, 1], [1, 0, 1, 0])
    )
    text = report.render_report(
        full(TOWN, []), ReportContext(title="Town"), lambda keys: {},
        lambda keys: {key: of_query if key.startswith("query") else of_answer for key in keys},
    )  # fmt: skip
    labels = re.findall(r'aria-label="Cosine by part: ([^"]+)"', text)
    # Five answers of each query, and the true match outside the first five.
    assert len(labels) == 4 * 5 + 1
    assert set(labels) == {"1.00 0.00 "}


def test_pair_queries_orders_by_the_merged_rank() -> None:
    single = [
        result(p, first, score)
        for p, ranks in (("a", (1, 1)), ("b", (1, 7)), ("c", (3, 2)), ("d", (1, 2)))
        for first, score in zip(ranks, (0.9, 0.8), strict=True)
    ]
    pairs = pair_queries(
        single,
        [merged("a", 2), merged("b", 1), merged("c", 4), merged("d", 1), merged("other", 1)],
        3,
    )
    assert [pair.merged["location"] for pair in pairs.shown] == ["c", "b", "d"]
    assert [pair.single["first_match_rank"] for pair in pairs.shown] == [3, 7, 2]
    assert pairs.shown[0].images == ("query-drone-c-0.8", "query-drone-c-0.9")
    assert (pairs.places, pairs.fixed, pairs.lost) == (3, 2, 1)


def test_page_opens_a_few_panels_and_folds_the_others() -> None:
    rows = [result(f"{i:04d}", 1, 0.5 + 0.01 * i) for i in range(20)]
    text = report.render_report(
        evaluation(rows), ReportContext(title="Town"), lambda keys: {}, panels=15
    )
    assert text.count('<article class="panel"') == 15
    assert "<summary>9 more hits</summary>" in text
    opened, folded = (
        set(map(int, re.findall(r'id="drone-satellite-hit-(\d+)"', half)))
        for half in text.split("<summary>")
    )
    assert (opened, opened | folded) == ({1, 4, 7, 9, 12, 15}, set(range(1, 16)))
    assert (
        report.render_report(
            evaluation(rows), ReportContext(title="Town"), lambda keys: {}, panels=0
        ).count("<article")
        == 0
    )


def test_group_tables_leave_out_a_single_group() -> None:
    [table] = group_tables([*GROUPS, GROUPS[0] | {"by": "variant"}], {TASK: "name"}, {TASK: 0.4})
    assert (table.heading, table.overall) == ("altitude m", 0.4)
    assert [line.label for line in table.rows] == ["50 to 100", "100 to 150"]
    assert (table.span, table.at(0.5)) == ((20.0, 80.0), 50.0)
    [parts] = part_tables([*PARTS, PARTS[0] | {"kept": "without"}], {TASK: "name"}, {TASK: 0.4})
    assert [line.label for line in parts.rows] == ["1 alone", "2 alone", "all but 1"]


def test_layout_scatter_keeps_distances_within_its_frame() -> None:
    drawn = layout_scatter(scatter(GAP))
    [first, second] = [
        tuple(map(float, at)) for at in re.findall(r"M([\d.]+) ([\d.]+)h0", drawn.discs)
    ]
    # One scale for both axes, and up is up.
    assert (first[1] - second[1]) * 4 == second[0] - first[0]
    assert all(0 <= x <= SCATTER_WIDTH and 0 <= y <= SCATTER_HEIGHT for x, y in (first, second))
    assert drawn.joins.startswith(f"M{first[0]} {first[1]}L")
    assert drawn.triangles.count("z") == 1
    assert drawn.scatter.statistics[0][:2] == ("Cosine of true pairs", "0.750 (0.50 to 1.00)")
    untrained = replace(evaluation(TOWN, name="untrained"), gaps=(GAP | {"distance": 0.5},))
    assert scatter(GAP, untrained).statistics[2][1:] == (
        "0.125", "in units of a view's spread; 0 where there is no gap; untrained: 0.500",
    )  # fmt: skip
