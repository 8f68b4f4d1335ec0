"""A map of errors: per-query rows with positions in, a picture's geometry, the farthest answers and their distances out.

The map is equirectangular, true to scale at its middle latitude: right for places some hundred metres apart, whichever
meridian they lie at, and a plain world map for places all over the world.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.metrics import Doubles
from pipeline.positions import EARTH_M
from pipeline.report_charts import Chart, Frame, Tick, nice_ticks

WIDTH, HEIGHT, MARGIN = 520, 360, 22
SMALLEST_M = 100.0  # across: a single place gets a map too
MOST_LINES = 300
WORST = 5
GRID_FROM_M = 50_000.0  # meridians and parallels mean something from here on
METRES_PER_DEGREE = EARTH_M * math.pi / 180

Row = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Place:
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
    places: tuple[Place, ...]
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


def located(rows: Sequence[Row]) -> list[Row]:
    """The queries whose place and whose best answer have positions."""
    return [row for row in rows if row.get("distance_m") is not None]


def error_map(title: str, rows: Sequence[Row]) -> ErrorMap | None:
    """None where no positions are known."""
    known = located(rows)
    if not known:
        return None
    of_place: dict[str, list[Row]] = {}
    for row in known:
        of_place.setdefault(row["location"], []).append(row)
    asked_L2 = np.array([np.mean([(row["lat"], row["lon"]) for row in each], axis=0) for each in of_place.values()])
    wrong = Counter(
        (row["location"], row["top_locations"][0], row["answer_lat"], row["answer_lon"])
        for row in known if row["first_match_rank"] != 1
    )  # fmt: skip
    far: dict[tuple[str, str], float] = {}
    for row in known:
        pair = row["location"], row["top_locations"][0]
        far[pair] = max(far.get(pair, 0.0), row["distance_m"])
    drawn = sorted(wrong, key=lambda line: (-far[line[:2]], line))[:MOST_LINES]
    answers_N2 = np.array([line[2:] for line in drawn]).reshape(-1, 2)
    sheet = Sheet.around(np.concatenate([asked_L2, answers_N2]))
    at = dict(zip(of_place, sheet.xy(asked_L2), strict=True))
    lines = []
    for line, end in zip(drawn, sheet.xy(answers_N2), strict=True):
        place, answer = line[:2]
        said = f"{place} taken for {answer}, {metres(far[place, answer])} off, {wrong[line]} of {len(of_place[place])}"
        lines.append((*at[place], *end, said))
    places = []
    for name, each in of_place.items():
        hits = sum(row["first_match_rank"] == 1 for row in each)
        said = f"{name}: {hits} of {len(each)} queries right"
        places.append(Place(x=at[name][0], y=at[name][1], found=2 * hits >= len(each), text=said))
    misses = sum(wrong.values())
    cut = f"; of {len(wrong):,} lines the {MOST_LINES} longest" if len(wrong) > MOST_LINES else ""
    return ErrorMap(
        title=title,
        note=f"{len(places):,} places; a line leads from a place to where a wrong first answer lies{cut}",
        summary=f"Map of {len(places):,} places: {misses:,} of {len(known):,} first answers are wrong",
        places=tuple(places), lines=tuple(lines), bar=sheet.bar(), meridians=sheet.meridians(), parallels=sheet.parallels(),
        worst=tuple(_worst(known)),
    )  # fmt: skip


def distance_chart(title: str, rows: Sequence[Row]) -> Chart | None:
    """Share of the queries whose best answer lies within so many metres, on a logarithmic axis; None without positions."""
    off_N = np.sort([row["distance_m"] for row in located(rows)])
    if not len(off_N):
        return None
    top = math.ceil(math.log10(max(off_N[-1], 10.0)))
    frame = Frame(0, top, 0, 1)
    at = np.linspace(0, top, 121)
    shares = np.searchsorted(off_N, 10**at, side="right") / len(off_N)
    return Chart(
        title=title, note="share of the queries whose best answer lies within so far of the place",
        summary=f"{title}: half within {metres(float(np.median(off_N)))}, the farthest {metres(float(off_N[-1]))} off",
        lines=(frame.line("within", "main", list(zip(at.tolist(), shares.tolist(), strict=True))),),
        x_ticks=tuple(Tick(at=frame.x(i), label=metres(10.0**i)) for i in range(0, top + 1, 1 if top < 6 else 2)),
        y_ticks=tuple(Tick(at=frame.y(y), label=f"{100 * y:g} %") for y in (0, 0.25, 0.5, 0.75, 1)),
    )  # fmt: skip


def metres(value: float) -> str:
    """As people say it: 12 m, 1.2 km, 3,400 km."""
    if value < 999.5:
        return f"{value:.0f} m"
    return f"{value / 1000:.2g} km" if value < 9_950 else f"{value / 1000:,.0f} km"


def _worst(known: Sequence[Row]) -> list[Row]:
    farthest: dict[str, Row] = {}
    for row in sorted(known, key=lambda row: (-row["distance_m"], row["query"])):
        if row["first_match_rank"] != 1:
            farthest.setdefault(row["location"], row)
    return list(farthest.values())[:WORST]


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """From positions to the map's coordinates."""

    south: float
    north: float
    west: float
    "The meridian that the map starts at; longitudes are counted eastwards from it."
    wide: float
    "Degrees of longitude across."
    scale: float
    "Map units per metre, at the middle latitude."

    @classmethod
    def around(cls, at_N2: Doubles) -> "Sheet":
        """A map that holds these positions (latitude, longitude)."""
        south, north = float(at_N2[:, 0].min()), float(at_N2[:, 0].max())
        meridians = np.unique(at_N2[:, 1] % 360)
        gaps = np.diff(meridians, append=meridians[0] + 360)
        widest = int(np.argmax(gaps))
        west, wide = float(meridians[(widest + 1) % len(meridians)]), float(360 - gaps[widest])
        if wide > 180:  # all over the world: as world maps are
            west, wide = -180.0, 360.0
        shrink = math.cos(math.radians((south + north) / 2))
        tall_m, wide_m = ((north - south) * METRES_PER_DEGREE, wide * METRES_PER_DEGREE * shrink)
        scale = min((WIDTH - 2 * MARGIN) / max(wide_m, SMALLEST_M), (HEIGHT - 2 * MARGIN) / max(tall_m, SMALLEST_M))
        return cls(south=south, north=north, west=west, wide=wide, scale=scale)

    @property
    def _shrink(self) -> float:
        return math.cos(math.radians((self.south + self.north) / 2))

    def x(self, lon: float) -> float:
        east = (lon - self.west) % 360
        east = (
            east - 360 if east > (360 + self.wide) / 2 else east
        )  # rounding may put the first meridian behind the last
        return round(WIDTH / 2 + (east - self.wide / 2) * METRES_PER_DEGREE * self._shrink * self.scale, 1)

    def y(self, lat: float) -> float:
        return round(HEIGHT / 2 - (lat - (self.south + self.north) / 2) * METRES_PER_DEGREE * self.scale, 1)

    def xy(self, at_N2: Doubles) -> list[tuple[float, float]]:
        return [(self.x(lon), self.y(lat)) for lat, lon in at_N2.tolist()]

    def bar(self) -> tuple[float, str]:
        """The longest round distance that takes at most a third of the map."""
        most = WIDTH / 3 / self.scale
        unit = 10.0 ** math.floor(math.log10(most))
        length = max(step * unit for step in (1, 2, 5) if step * unit <= most)
        return round(length * self.scale, 1), metres(length)

    def meridians(self) -> tuple[Tick, ...]:
        """Round longitudes across a map of a country or more."""
        ticks = nice_ticks(self.west, self.west + self.wide) if self._wants_grid() else []
        inside = [lon for lon in ticks if self.west <= lon <= self.west + self.wide]
        return tuple(Tick(at=self.x(lon), label=_degrees((lon + 180) % 360 - 180, "EW")) for lon in inside)

    def parallels(self) -> tuple[Tick, ...]:
        ticks = nice_ticks(self.south, self.north) if self._wants_grid() else []
        inside = [lat for lat in ticks if self.south <= lat <= self.north]
        return tuple(Tick(at=self.y(lat), label=_degrees(lat, "NS")) for lat in inside)

    def _wants_grid(self) -> bool:
        return WIDTH / self.scale >= GRID_FROM_M


def _degrees(value: float, letters: str) -> str:
    return f"{abs(value):g}°" + (f" {letters[value < 0]}" if value else "")
