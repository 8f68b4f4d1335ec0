"""A map of errors: per-query rows with positions in, a picture's geometry, the farthest answers and
their distances out.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.report.map_sheet import MapSheet, format_metres
from pipeline.report.svg import Chart, Frame, Tick

MAX_LINES = 300
MAX_WORST = 5

Row = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class MapLocation:
    """A place that was asked for."""

    x: float
    y: float
    found: bool
    "Whether at least half of its queries have it first."
    text: str


@dataclass(frozen=True, kw_only=True)
class ErrorMap:
    title: str
    note: str
    summary: str
    places: tuple[MapLocation, ...]
    lines: tuple[tuple[float, float, float, float, str], ...]
    "From a place to where a wrong first answer lies, and what to say of it."
    bar: tuple[float, str]
    "Length of the scale bar and what it stands for."
    meridians: tuple[Tick, ...]
    parallels: tuple[Tick, ...]
    worst: tuple[Row, ...]
    "Of different places the queries whose first answer lies farthest off."

    @property
    def opacity(self) -> float:
        """Of the lines: many are drawn fainter."""
        return min(0.65, 4 / math.sqrt(max(len(self.lines), 1)))


def with_positions(rows: Sequence[Row]) -> list[Row]:
    """The queries whose place and whose best answer have positions."""
    return [row for row in rows if row.get("distance_m") is not None]


def error_map(title: str, rows: Sequence[Row]) -> ErrorMap | None:
    """None where no positions are known."""
    known = with_positions(rows)
    if not known:
        return None
    of_place: dict[str, list[Row]] = {}
    for row in known:
        of_place.setdefault(row["location"], []).append(row)
    asked_L2 = np.array([(each[0]["lat"], each[0]["lon"]) for each in of_place.values()])
    wrong = Counter(
        (row["location"], row["top_locations"][0], row["answer_lat"], row["answer_lon"])
        for row in known if row["first_match_rank"] != 1
    )  # fmt: skip
    far: dict[tuple[str, str], float] = {}
    for row in known:
        pair = row["location"], row["top_locations"][0]
        far[pair] = max(far.get(pair, 0.0), row["distance_m"])
    drawn = sorted(wrong, key=lambda line: (-far[line[:2]], line))[:MAX_LINES]
    answers_N2 = np.array([line[2:] for line in drawn]).reshape(-1, 2)
    sheet = MapSheet.around(np.concatenate([asked_L2, answers_N2]))
    at = dict(zip(of_place, sheet.xy(asked_L2), strict=True))
    lines = []
    for line, end in zip(drawn, sheet.xy(answers_N2), strict=True):
        place, answer = line[:2]
        said = f"{place} taken for {answer}, {format_metres(far[place, answer])} off, {wrong[line]} of {len(of_place[place])}"
        lines.append((*at[place], *end, said))
    places = []
    for name, each in of_place.items():
        hits = sum(row["first_match_rank"] == 1 for row in each)
        said = f"{name}: {hits} of {len(each)} queries right"
        places.append(
            MapLocation(x=at[name][0], y=at[name][1], found=2 * hits >= len(each), text=said)
        )
    misses = sum(wrong.values())
    cut = f"; of {len(wrong):,} lines the {MAX_LINES} longest" if len(wrong) > MAX_LINES else ""
    return ErrorMap(
        title=title,
        note=f"{len(places):,} places; a line leads from a place to where a wrong first answer lies{cut}",
        summary=f"Map of {len(places):,} places: {misses:,} of {len(known):,} first answers are wrong",
        places=tuple(places),
        lines=tuple(lines),
        bar=sheet.bar(),
        meridians=sheet.meridians(),
        parallels=sheet.parallels(),
        worst=tuple(_worst(known)),
    )


def distance_chart(title: str, rows: Sequence[Row]) -> Chart | None:
    """Share of the queries whose best answer lies within so many metres, on a logarithmic axis;
    None without positions.
    """
    off_N = np.sort([row["distance_m"] for row in with_positions(rows)])
    if not len(off_N):
        return None
    top = math.ceil(math.log10(max(off_N[-1], 10.0)))
    frame = Frame(0, top, 0, 1)
    at = np.linspace(0, top, 121)
    shares = np.searchsorted(off_N, 10**at, side="right") / len(off_N)
    return Chart(
        title=title,
        note="share of the queries whose best answer lies within so far of the place",
        summary=f"{title}: half within {format_metres(float(np.median(off_N)))}, the farthest {format_metres(float(off_N[-1]))} off",
        lines=(frame.line("within", "main", list(zip(at.tolist(), shares.tolist(), strict=True))),),
        x_ticks=tuple(
            Tick(at=frame.x(i), label=format_metres(10.0**i))
            for i in range(0, top + 1, 1 if top < 6 else 2)
        ),
        y_ticks=tuple(Tick(at=frame.y(y), label=f"{100 * y:g} %") for y in (0, 0.25, 0.5, 0.75, 1)),
    )


def _worst(known: Sequence[Row]) -> list[Row]:
    farthest: dict[str, Row] = {}
    for row in sorted(known, key=lambda row: (-row["distance_m"], row["query"])):
        if row["first_match_rank"] != 1:
            farthest.setdefault(row["location"], row)
    return list(farthest.values())[:MAX_WORST]
