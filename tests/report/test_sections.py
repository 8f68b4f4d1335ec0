"""Sections of the page beside the measures: groups, parts, the view gap, and one image beside all
of its place.
"""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.report import page as report
from pipeline.report.charts import HEIGHT, WIDTH, scatter
from pipeline.report.inputs import EvaluationResults, ReportContext
from pipeline.report.tables import group_tables, part_tables
from pipeline.report.tasks import pair_queries
from pipeline.retrieval.tasks import RESULTS_SCHEMA
from tests.report.test_page import TOWN, findings, jpeg, result

TASK = "drone->satellite"
SURE: dict[str, Any] = {"r1_low": 0.25, "r1_high": 0.75, "ap": 0.5, "queries": 4}
GROUPS = tuple(
    {"task": TASK, "by": "altitude_m", "value": v, "r1": 0.5} | SURE
    for v in ("50 to 100", "100 to 150")
)
PARTS = tuple(
    {"task": TASK, "parts": 2, "part": p, "kept": "alone", "r1": p / 4} | SURE for p in (1, 2)
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
    plain = findings(single)
    metrics = [plain.metrics[0], plain.metrics[0] | {"multi_query": True, "queries": len(multi)}]
    return replace(
        plain,
        metrics=metrics,
        results=pa.Table.from_pylist([*single, *multi], RESULTS_SCHEMA),
        groups=GROUPS,
        parts=PARTS,
        gaps=(GAP,),
    )


def test_the_page_has_the_sections_that_there_is_something_for() -> None:
    multi = [merged(row["location"], 1) for row in TOWN]
    text = report.render_report(
        full(TOWN, multi),
        ReportContext(title="Town"),
        lambda keys: dict.fromkeys(keys, jpeg("olive")),
    )
    anchors = set(re.findall(r'<a href="#([^"]+)">', text))
    assert {"groups", "parts", "gap", "drone-satellite-pairs"} <= anchors
    assert anchors <= set(re.findall(r' id="([^"]+)"', text))
    plain = report.render_report(findings(TOWN), ReportContext(title="Town"), lambda keys: {})
    assert not {"groups", "parts", "gap", "map", "drone-satellite-pairs"} & set(
        re.findall(r'<section id="([^"]+)"', plain)
    )


def test_answers_say_part_by_part_how_they_agree() -> None:
    # Of two parts the first agrees wholly with every answer, the second not at all.
    of_query, of_answer = (
        np.array(vector, np.float32) / np.float32(np.sqrt(2))
        for vector in ([1, 0, 0, 1], [1, 0, 1, 0])
    )
    text = report.render_report(
        full(TOWN, []), ReportContext(title="Town"), lambda keys: {},
        lambda keys: {key: of_query if key.startswith("query") else of_answer for key in keys},
    )  # fmt: skip
    said = re.findall(r'aria-label="Cosine by part: ([^"]+)"', text)
    assert (
        len(said) == 4 * 5 + 1
    )  # five answers of each query, and the true match that is set apart
    assert set(said) == {"1.00 0.00 "}


def test_one_image_stands_beside_all_from_the_place_left_farthest_to_those_found() -> None:
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
    assert (pairs.places, pairs.mended, pairs.lost) == (3, 2, 1)


def test_a_few_panels_spread_over_all_are_open_and_the_others_unfold() -> None:
    rows = [result(f"{i:04d}", 1, 0.5 + 0.01 * i) for i in range(20)]
    text = report.render_report(
        findings(rows), ReportContext(title="Town"), lambda keys: {}, panels=15
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
            findings(rows), ReportContext(title="Town"), lambda keys: {}, panels=0
        ).count("<article")
        == 0
    )


def test_tables_leave_out_a_group_that_is_the_whole_task() -> None:
    [table] = group_tables([*GROUPS, GROUPS[0] | {"by": "variant"}], {TASK: "name"}, {TASK: 0.4})
    assert (table.heading, table.overall) == ("altitude m", 0.4)
    assert [line.label for line in table.lines] == ["50 to 100", "100 to 150"]
    assert (table.span, table.at(0.5)) == ((20.0, 80.0), 50.0)
    [parts] = part_tables([*PARTS, PARTS[0] | {"kept": "without"}], {TASK: "name"}, {TASK: 0.4})
    assert [line.label for line in parts.lines] == ["1 alone", "2 alone", "all but 1"]


def test_the_scatter_keeps_distances_and_lies_within_its_frame() -> None:
    drawn = scatter(GAP)
    [first, second] = [
        tuple(map(float, at)) for at in re.findall(r"M([\d.]+) ([\d.]+)h0", drawn.dots)
    ]
    assert (first[1] - second[1]) * 4 == second[0] - first[
        0
    ]  # one scale for both axes, and up is up
    assert all(0 <= x <= WIDTH and 0 <= y <= HEIGHT for x, y in (first, second))
    assert drawn.joins.startswith(f"M{first[0]} {first[1]}L")
    assert drawn.triangles.count("z") == 1
    assert drawn.figures[0][:2] == ("Cosine of true pairs", "0.750 (0.50 to 1.00)")
    untrained = replace(findings(TOWN, name="untrained"), gaps=(GAP | {"distance": 0.5},))
    assert scatter(GAP, untrained).figures[2][1:] == (
        "0.125", "in units of a view's spread; 0 where there is no gap; untrained: 0.500",
    )  # fmt: skip
