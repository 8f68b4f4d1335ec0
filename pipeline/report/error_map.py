"""The map of errors and the curve of distances: per-query rows with positions in, a map in sheet
coordinates, the farthest answers and a chart out. Page and papers draw the same map."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.report.charts import Axis, Chart, Row, Series, Tick, share_axis
from pipeline.report.map_sheet import MapSheet, format_metres

MAX_LINES = 300
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
class ErrorMap:
    title: str
    note: str
    summary: str
    places: tuple[MapLocation, ...]
    lines: tuple[tuple[float, float, float, float, str], ...]
    "From a place to the position of a wrong first answer: x, y, x, y and the text."
    bar: tuple[float, str]
    "Length of the scale bar and its label."
    meridians: tuple[Tick, ...]
    parallels: tuple[Tick, ...]
    worst: tuple[Row, ...]
    "The queries whose first answer lies farthest off, one per place."

    @property
    def opacity(self) -> float:
        """Opacity of the lines: the more there are, the fainter."""
        return min(0.65, 4 / math.sqrt(max(len(self.lines), 1)))


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
    at = dict(zip(by_place, sheet.xy(asked_L2), strict=True))
    lines = []
    for line, end in zip(drawn, sheet.xy(answers_N2), strict=True):
        place, answer = line[:2]
        text = (
            f"{place} taken for {answer}, {format_metres(far[place, answer])} off, "
            f"{wrong[line]} of {len(by_place[place])}"
        )
        lines.append((*at[place], *end, text))
    places = []
    for name, each in by_place.items():
        hits = sum(row["first_match_rank"] == 1 for row in each)
        text = f"{name}: {hits} of {len(each)} queries right"
        places.append(
            MapLocation(x=at[name][0], y=at[name][1], found=2 * hits >= len(each), text=text)
        )
    misses = sum(wrong.values())
    cut = f"; of {len(wrong):,} lines the {MAX_LINES} longest" if len(wrong) > MAX_LINES else ""
    return ErrorMap(
        title=title,
        note=f"{len(places):,} places; "
        f"a line leads from a place to where a wrong first answer lies{cut}",
        summary=f"Map of {len(places):,} places: "
        f"{misses:,} of {len(known):,} first answers are wrong",
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


def _worst(known: Sequence[Row]) -> list[Row]:
    farthest: dict[str, Row] = {}
    for row in sorted(known, key=lambda row: (-row["distance_m"], row["query"])):
        if row["first_match_rank"] != 1:
            farthest.setdefault(row["location"], row)
    return list(farthest.values())[:MAX_WORST]
