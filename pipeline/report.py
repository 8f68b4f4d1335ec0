"""Results -> one self-contained HTML page: measures, curves, and hits and misses with their pictures.

In: an evaluation, what is shown beside it, and a way to fetch pictures by key. Out: the page as text; the same input
gives the same page. Nothing on it runs or leaves it: no script, no font, no request (its Content-Security-Policy says so),
and every name in it is escaped, as location names are whatever a folder was called.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from pipeline import metrics
from pipeline.metrics import Whole
from pipeline.report_charts import HEIGHT, WIDTH, Chart, recall_chart, training_charts
from pipeline.report_evidence import scores_chart, views_chart
from pipeline.report_inputs import Extras, Findings, Pictures, no_pictures, read_extras, read_findings, read_views
from pipeline.report_panels import PANELS, distance, is_hit, keys_shown, make_panel, spread, sureness

__all__ = ["Extras", "Findings", "Pictures", "no_pictures", "read_extras", "read_findings", "read_views", "render"]

MEASURES = {"r1": "R@1", "r5": "R@5", "r10": "R@10", "r1p": "R@1%", "ap": "AP"}
PROTOCOLS = {
    "full": "the official protocol: the whole gallery is ranked, with its distractors",
    "queried-only": "the reduced protocol: gallery images of places that are not queried are left out, so its figures do "
    "not compare with those of the official one",
}


def render(findings: Findings, extras: Extras, pictures: Pictures) -> str:
    """The page.

    Raises InputError when the evaluation beside ranked other images.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {
        "percent": lambda value: f"{100 * value:.2f}",
        "points": lambda value: f"{100 * value:+.2f}",
    }
    rows_of = [findings.results_of(row) for row in findings.metrics]
    tasks = [_task(row, rows, extras) for row, rows in zip(findings.metrics, rows_of, strict=True)]
    panels = [(task, rows) for task, rows in zip(tasks, rows_of, strict=True) if not task["multi_query"]]
    return environment.get_template("report.html").render(
        title=extras.title,
        fingerprint=findings.metrics[0]["fingerprint"],
        protocol=PROTOCOLS[findings.metrics[0]["protocol"]],
        measures=MEASURES,
        tasks=tasks,
        beside=extras.beside.name if extras.beside else None,
        evidence=_evidence(findings, tasks, rows_of),
        training=training_charts(extras.training),
        sections=[_section(task, rows, pictures) for task, rows in panels],
        width=WIDTH,
        height=HEIGHT,
    )


def _task(row: Mapping[str, Any], rows: list[dict[str, Any]], extras: Extras) -> dict[str, Any]:
    """A line of the table and its recall curve."""
    query_view, gallery_view = row["task"].split("->")
    other = extras.beside.of(dict(row)) if extras.beside else None
    matches_Q = np.array([each["matches"] for each in rows], np.int64)
    name = f"{query_view} → {gallery_view}" + (", multi-query" if row["multi_query"] else "")
    return {
        **row, "name": name, "anchor": name.replace(" → ", "-").replace(", ", "-"),
        "query_view": query_view, "gallery_view": gallery_view, "other": other,
        "first": sum(is_hit(each) for each in rows), "unmatched": int(np.count_nonzero(matches_Q == 0)),
        "chance": metrics.chance(matches_Q, row["gallery"]), "one_percent": metrics.one_percent(row["gallery"]),
        "sure": {name: (row[f"{name}_low"], row[f"{name}_high"]) for name in MEASURES if row.get(f"{name}_low") is not None},
        "geo": row if row.get("geo_queries") else None,
        "chart": _recall_chart(name, row, rows, extras if other else None),
    }  # fmt: skip


def _evidence(findings: Findings, tasks: list[dict[str, Any]], rows_of: list[list[dict[str, Any]]]) -> list[Chart]:
    """R@1 by number of views, and for each task of single queries how the scores of right and wrong answers part."""
    single = [(task, rows) for task, rows in zip(tasks, rows_of, strict=True) if not task["multi_query"]]
    of_views = [
        views_chart(
            f"{task['name']}, R@1 by views a query", [row for row in findings.views if row["task"] == task["task"]]
        )
        for task, _ in single
    ]
    charts = [*of_views, *(scores_chart(f"{task['name']}, scores", rows) for task, rows in single)]
    return [chart for chart in charts if chart]


def _recall_chart(name: str, row: Mapping[str, Any], rows: list[dict[str, Any]], extras: Extras | None) -> Chart:
    beside = extras.beside if extras else None
    beside_Q = _first_ranks(beside.results_of(dict(row))) if beside else None
    note = f"{row['queries']:,} queries, {row['gallery']:,} in the gallery"
    return recall_chart(name, note, _first_ranks(rows), row["gallery"], beside_Q, beside.name if beside else "")


def _first_ranks(rows: list[dict[str, Any]]) -> Whole:
    return np.array([row["first_match_rank"] or 0 for row in rows], np.int64)


def _section(task: dict[str, Any], rows: list[dict[str, Any]], pictures: Pictures) -> dict[str, Any]:
    """A task's hits, from the surest to the least sure, and its misses, from the farthest off to the nearly right."""
    hits = spread([row for row in rows if is_hit(row)], PANELS, sureness)
    misses = spread([row for row in rows if not is_hit(row)], PANELS, distance)
    images = pictures(sorted(keys_shown([*hits, *misses])))
    return {
        "task": task, "pictures": bool(images),
        "hits": [make_panel(row, images) for row in hits], "misses": [make_panel(row, images) for row in misses],
    }  # fmt: skip
