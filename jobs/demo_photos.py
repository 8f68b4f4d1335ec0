"""The demo's end: a few photos of places never seen in training are asked of the index, and the answers held against the truth.

In: the demo's folder with its data set, network and index. Out: how far off each answer is, and a page with the map.
"""

import csv
import io
from dataclasses import dataclass, replace

from rich import box
from rich.table import Table

from jobs.calibrate import Settings as CalibrationSettings
from jobs.calibrate import calibrate_index
from jobs.locate import Settings as LocateSettings
from jobs.locate import locate_photos
from pipeline import storage
from pipeline.answer_files import Located
from pipeline.answer_page import Place, away_m, told_m
from pipeline.progress import console, results
from pipeline.records import InputError

PHOTOS = 10
"Places that are asked for, each by its first photo and by all of its photos together."


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Where the demo has put what it made."""

    flights: str
    shards: str
    checkpoint: str
    index: str
    out: str
    "Folder for the answers."


def locate_some(demo: Demo) -> str:
    """Calibrate the index, locate photos, print how far off they are; the page's path."""
    try:
        calibrate_index(CalibrationSettings(checkpoint=demo.checkpoint, shards=demo.shards, index=demo.index))
    except InputError as error:  # a demo made smaller than it is may hold out too few places
        console.print(f"not calibrated: {error}")
    places = positions(storage.join(demo.flights, "locations.csv"))
    root = storage.join(demo.flights, "test", "query_drone")
    names = sorted(name for name in places if storage.is_folder(storage.join(root, name)))[:PHOTOS]
    folders = {storage.join(root, name): places[name] for name in names}
    firsts = {storage.join(folder, storage.names(folder)[0]): place for folder, place in folders.items()}
    page = storage.join(demo.out, "photos.html")
    asked = LocateSettings(
        photos=tuple(firsts), checkpoint=demo.checkpoint, index=demo.index, shards=demo.shards, page=page,
        out=storage.join(demo.out, "photos.geojson"),
    )  # fmt: skip
    alone = locate_photos(asked, firsts)
    of_places = storage.join(demo.out, "places.geojson")
    together = locate_photos(replace(asked, photos=tuple(folders), together=True, out=of_places, page=None))
    table = Table(title="unseen UAV photos: how far off", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading in ("place", "one photo", "sure", "all together", "sure"):
        table.add_column(heading, justify="left" if heading == "place" else "right", no_wrap=True)
    for name, one, all_ in zip(names, alone, together, strict=True):
        table.add_row(name, *_cells(one, places[name]), *_cells(all_, places[name]))
    results.print(table)
    return page


def positions(path: str) -> dict[str, Place]:
    """Latitude and longitude by location, as the simulator wrote them."""
    rows = csv.DictReader(io.StringIO(storage.read_bytes(path).decode()))
    return {row["location"]: (float(row["lat"]), float(row["lon"])) for row in rows}


def _cells(one: Located, place: Place) -> tuple[str, str]:
    """How far off an answer is, and how sure it was."""
    answer = one.answer
    if answer is None:
        return "not decoded", ""
    off = told_m(away_m(answer, place))
    sure = "" if answer.probability is None else f"{answer.probability:.0%}"
    return off if answer.known else f"unknown ({off})", sure
