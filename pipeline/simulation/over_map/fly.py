"""The stage of a simulated flight over a map: settings come in, photos and their table go out.

    photos/<number>.jpg    JPEGs with heading, pitch, height and lens in their tags, as sensors err
    overhead/<place>.jpg   with --overhead-m: each place's piece of the map
    photos.csv             path, location, lat, lon, altitude_m, heading_deg, pitch_deg: the truth,
                           as `make_shards --source table` reads it; with --overhead-m view, split
    times.csv, odometry.csv    of a survey or a spiral, as `locate --track` reads them
    flight.json            the settings; written last

Each place is one task, and a rerun resumes with the missing ones.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import ray

from pipeline.camera.pose import Pose
from pipeline.core import cluster, json_files, storage
from pipeline.core.lock import locks_output
from pipeline.core.progress import console, progress
from pipeline.core.records import Split, View
from pipeline.simulation.layout import write_table
from pipeline.simulation.over_map.photo import MapPlace, photos_over_map
from pipeline.simulation.over_map.settings import UNUSED_FIELDS, MapFlightSettings
from pipeline.simulation.over_map.survey import camera_moves, odometry_rows, time_rows
from pipeline.simulation.resume import begin, is_complete, local_root, settings_record
from pipeline.sources.maps.sheets import as_one_map

TABLE, COMPLETE = "photos.csv", "flight.json"
PHOTO_S = 0.7
"About what a photo takes a core: fewer of them do not wait for Ray."
TIMES, ODOMETRY = "times.csv", "odometry.csv"


@locks_output(lambda settings: settings.out)
def fly(settings: MapFlightSettings) -> Path:
    """Write the photos, or the missing ones, and their table; the folder.

    Raises InputError for a map that cannot be flown over, or a folder of another flight.
    """
    root = local_root(settings.out)
    left_out = ("out", "workers", "camera", *UNUSED_FIELDS[settings.plan])
    about = settings_record(settings, left_out) | settings.lens
    if is_complete(root, about, COMPLETE, "a flight with other settings,", "jobs/fly.py"):
        console.print(f"{root} is complete already; nothing to do")
        return root
    begin(root, about)
    of_sheets = with_one_map(settings, str(root / ".parts"))
    places = range(-(-settings.photos // settings.views))
    missing = [place for place in places if not _part(root, place).exists()]
    with progress(len(missing), "fly", "places") as meter:
        for _ in _visit_places(of_sheets, root, missing):
            meter.advance()
    parts = [json_files.read_checksummed(str(_part(root, place))) for place in places]
    rows = [row for part in parts for row in part["rows"]]
    write_table(root / TABLE, rows)
    if settings.plan != "places":
        _write_track(settings, root, [row for row in rows if row["path"].startswith("photos/")])
    json_files.write_checksummed(str(root / COMPLETE), about)
    storage.remove_folder(str(root / ".parts"))
    console.print(f"{root}: {settings.photos} photos over {settings.mosaic}", markup=False)
    return root


def with_one_map(settings: MapFlightSettings, folder: str) -> MapFlightSettings:
    """The settings with map and surface model as one path each: where they are folders, VRTs that
    are written to `folder`."""
    surface = settings.surface
    return replace(
        settings,
        mosaic=as_one_map(settings.mosaic, storage.join(folder, "map.vrt")),
        surface=surface and as_one_map(surface, storage.join(folder, "surface.vrt")),
    )


def _visit_places(settings: MapFlightSettings, root: Path, places: list[int]) -> Iterator[None]:
    workers = cluster.workers_for(settings.workers, len(places) * settings.views * PHOTO_S)
    if workers == 0:
        for place in places:
            write_place(settings, str(root), place)
            yield
        return
    cluster.connect()
    task, window = ray.remote(num_cpus=1)(write_place), workers or 2 * cluster.cpus()
    submit = partial(task.remote, settings, str(root))
    for _ in cluster.bounded_map(submit, places, window):
        yield None


def write_place(settings: MapFlightSettings, root: str, place: int) -> None:
    """Take a place's photos and write them, then the part with their rows."""
    first = place * settings.views
    count = min(settings.views, settings.photos - first)
    found = photos_over_map(settings, place, count)
    rows = []
    for number, photo in enumerate(found.photos, first):
        rows.append(_row(settings, found, f"photos/{number:05d}.jpg", place, photo.pose))
        storage.write_bytes(str(Path(root) / rows[-1]["path"]), photo.jpeg)
    if found.overhead is not None:
        rows.append(_row(settings, found, f"overhead/{place:05d}.jpg", place, None))
        storage.write_bytes(str(Path(root) / rows[-1]["path"]), found.overhead)
    json_files.write_checksummed(str(_part(Path(root), place)), {"rows": rows})


def _row(
    settings: MapFlightSettings, found: MapPlace, path: str, place: int, pose: Pose | None
) -> dict[str, str]:
    """The table's row of a photo, or, without a pose, of a piece of the map."""
    row = {
        "path": path,
        "location": f"{settings.location_of(place):05d}",
        "lat": f"{found.lat:.8f}",
        "lon": f"{found.lon:.8f}",
        "altitude_m": f"{pose.altitude_m:.2f}" if pose else "",
        "heading_deg": f"{pose.heading_deg:.2f}" if pose else "",
        "pitch_deg": f"{pose.pitch_deg:.2f}" if pose else "",
    }
    if settings.overhead_m is None:
        return row
    test = Split.QUERY if pose else Split.GALLERY
    split = test if settings.part == "held-out" else Split.TRAIN
    return row | {"view": View.DRONE if pose else View.SATELLITE, "split": split}


def _write_track(settings: MapFlightSettings, root: Path, rows: list[dict[str, str]]) -> None:
    """The times of a flight's photos, and its odometry."""
    names = [row["path"].rpartition("/")[2] for row in rows]
    moves_M2 = camera_moves(rows)
    steps_M = np.linalg.norm(moves_M2, axis=1)
    if settings.plan == "survey":
        steps_M[:] = settings.every_m  # along the lines, and around their corners
    write_table(root / TIMES, time_rows(names, steps_M, settings.speed))
    odometry = odometry_rows(names, moves_M2, settings.odometry_error, settings.seed)
    write_table(root / ODOMETRY, odometry)


def _part(root: Path, place: int) -> Path:
    return root / ".parts" / f"{place:05d}.json"
