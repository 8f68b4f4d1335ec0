"""The map of errors and the curve of distances: per-query rows with positions in, a map in sheet
coordinates, the farthest answers and a chart out. Page and papers draw the same map."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.report.charts import Axis, Chart, Row, Series, Tick, share_axis
from pipeline.report.map_sheet import MapSheet, format_metres

MAX_ARROWS = 300
SHORTEST_ARROW_PX = 2.0
"Shorter ones are hidden by the dots of their places."
MAX_WORST = 5


@dataclass(frozen=True, kw_only=True)
class MapLocation:
    """A place that was queried."""

    x: float
    y: float
    found: bool
    "At least half of its queries have it first."
    text: str


@dataclass(frozen=True, kw_only=True)
class ErrorArrow:
    """From where queries were taken to the position of their first answer."""

    x1: float
    y1: float
    x2: float
    y2: float
    right: bool
    "The answer is of the queries' own place."
    text: str


@dataclass(frozen=True, kw_only=True)
class ErrorMap:
    title: str
    note: str
    summary: str
    places: tuple[MapLocation, ...]
    arrows: tuple[ErrorArrow, ...]
    bar: tuple[float, str]
    "Length of the scale bar and its label."
    meridians: tuple[Tick, ...]
    parallels: tuple[Tick, ...]
    worst: tuple[Row, ...]
    "The queries whose first answer lies farthest off, one per place."

    @property
    def opacity(self) -> float:
        """Opacity of the arrows: the more there are, the fainter."""
        return min(0.8, 6 / math.sqrt(max(len(self.arrows), 1)))


def with_positions(rows: Sequence[Row]) -> list[Row]:
    """The queries whose place and best answer both have positions."""
    return [row for row in rows if row.get("distance_m") is not None]


def error_map(title: str, rows: Sequence[Row]) -> ErrorMap | None:
    """The map of one task; None if no positions are known."""
    known = with_positions(rows)
    if not known:
        return None
    by_place: dict[str, list[Row]] = {}
    for row in known:
        by_place.setdefault(row["location"], []).append(row)
    asked_L2 = np.array([(each[0]["lat"], each[0]["lon"]) for each in by_place.values()])
    off = [row for row in known if row["distance_m"] > 0]
    errors = Counter(_ends(row) for row in off)
    rows_of = {_ends(row): row for row in off}
    drawn = sorted(errors, key=lambda ends: (-rows_of[ends]["distance_m"], ends))[:MAX_ARROWS]
    ends_A4 = np.array([ends[2:] for ends in drawn]).reshape(-1, 4)
    sheet = MapSheet.around(np.concatenate([asked_L2, ends_A4[:, :2], ends_A4[:, 2:]]))
    at = dict(zip(by_place, sheet.xy(asked_L2), strict=True))
    arrows = []
    for ends, (x1, y1), (x2, y2) in zip(
        drawn, sheet.xy(ends_A4[:, :2]), sheet.xy(ends_A4[:, 2:]), strict=True
    ):
        row, (place, answer) = rows_of[ends], ends[:2]
        right = row["first_match_rank"] == 1
        if right and math.hypot(x2 - x1, y2 - y1) < SHORTEST_ARROW_PX:
            continue
        taken = "answered by an image of its own place" if right else f"taken for {answer}"
        count = f"{errors[ends]} of {len(by_place[place])}"
        text = f"{place} {taken}, {format_metres(row['distance_m'])} off, {count}"
        arrows.append(ErrorArrow(x1=x1, y1=y1, x2=x2, y2=y2, right=right, text=text))
    places = []
    for name, each in by_place.items():
        hits = sum(row["first_match_rank"] == 1 for row in each)
        text = f"{name}: {hits} of {len(each)} queries right"
        places.append(
            MapLocation(x=at[name][0], y=at[name][1], found=2 * hits >= len(each), text=text)
        )
    misses = sum(row["first_match_rank"] != 1 for row in known)
    cut = (
        f"; of {len(errors):,} arrows the {MAX_ARROWS} longest" if len(errors) > MAX_ARROWS else ""
    )
    return ErrorMap(
        title=title,
        note=f"{len(places):,} places; an arrow leads from where a query was taken to where its "
        f"first answer lies{cut}",
        summary=f"Map of {len(places):,} places: "
        f"{misses:,} of {len(known):,} first answers are wrong",
        places=tuple(places),
        arrows=tuple(arrows),
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
    within = 10.0 ** np.linspace(0, top, 121)
    shares = np.searchsorted(off_N, within, side="right") / len(off_N)
    # Six labels would touch.
    decades = [10.0**i for i in range(0, top + 1, 1 if top < 5 else 2)]
    ticks = tuple(Tick(at=each, label=format_metres(each)) for each in decades)
    points = tuple(zip(within.tolist(), shares.tolist(), strict=True))
    return Chart(
        title=title,
        note="share of the queries whose best answer lies within so far of the place",
        summary=f"{title}: half within {format_metres(float(np.median(off_N)))}, "
        f"the farthest {format_metres(float(off_N[-1]))} off",
        series=(Series(name="within", points=points),),
        x=Axis(label="distance (m)", low=1, high=10.0**top, ticks=ticks, log=True),
        y=share_axis("queries"),
    )


def _ends(row: Row) -> tuple[str, str, float, float, float, float]:
    """Place and answer of a query, and where both lie: queries that share them share an arrow."""
    return (
        row["location"], row["top_locations"][0],
        row["lat"], row["lon"], row["answer_lat"], row["answer_lon"],
    )  # fmt: skip


def _worst(known: Sequence[Row]) -> list[Row]:
    farthest: dict[str, Row] = {}
    for row in sorted(known, key=lambda row: (-row["distance_m"], row["query"])):
        if row["first_match_rank"] != 1:
            farthest.setdefault(row["location"], row)
    return list(farthest.values())[:MAX_WORST]
