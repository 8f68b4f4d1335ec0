"""The leaderboard's page: rows of many methods in; one self-contained HTML page out.

Like the report it runs no script and loads nothing.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.core.templates import template_environment


def render_leaderboard(
    rows: Sequence[Mapping[str, Any]],
    published: Sequence[Mapping[str, Any]],
    data: str,
    terms: str,
) -> str:
    """Render rows of `LeaderboardRow.as_dict` and of `PublishedResult`, best first.

    `data` and `terms` say in words what was trained on and at what cost.
    """
    ordered = sorted(rows, key=lambda row: -row["tasks"][0]["r1"])
    lows = [task["low"] for row in rows for task in row["tasks"][:1]]
    highs = [task["high"] for row in rows for task in row["tasks"][:1]]
    start, end = min(lows), max(highs)
    environment = template_environment(Path(__file__).parent / "templates")
    environment.filters |= {
        "percent": lambda value: f"{100 * value:.1f}",
        "points": lambda value: f"{100 * value:+.1f}",
        "along": lambda value: f"{100 * (value - start) / max(end - start, 1e-9):.1f}",
    }
    return environment.get_template("leaderboard.html").render(
        rows=ordered,
        baseline=rows[0]["method"],
        published=sorted(published, key=lambda row: -row["drone_to_satellite"][0]),
        data=data,
        terms=terms,
        span=(start, end),
    )
