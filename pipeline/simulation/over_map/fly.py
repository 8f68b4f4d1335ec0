"""The stage of a simulated flight over a map: settings come in, photos and their table go out.

    photos/<number>.jpg    JPEGs with heading, pitch, height and lens in their tags, as sensors err
    photos.csv             path, location, lat, lon, altitude_m, heading_deg, pitch_deg: the truth,
                           as `make_shards --source table` reads it
    flight.json            the settings; written last

Each photo is one task, and a rerun resumes with the missing ones.
"""

from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path

import ray

from pipeline.core import cluster, json_files, storage
from pipeline.core.errors import InputError
from pipeline.core.lock import locks_output
from pipeline.core.progress import console, progress
from pipeline.simulation.layout import write_table
from pipeline.simulation.over_map.photo import photo_over_map
from pipeline.simulation.over_map.settings import MapFlightSettings
from pipeline.simulation.resume import begin, is_complete

TABLE, COMPLETE = "photos.csv", "flight.json"


@locks_output(lambda settings: settings.out)
def fly(settings: MapFlightSettings) -> Path:
    """Write the photos, or the missing ones, and their table; the folder.

    Raises InputError for a map that cannot be flown over, or a folder of another flight.
    """
    if not storage.is_local(settings.out):
        raise InputError(
            f"--out is {settings.out}, expected a local or mounted folder; write it there and copy"
        )
    root = Path(storage.resolve(settings.out)[1]).absolute()
    others = ("out", "workers")
    about = {name: value for name, value in asdict(settings).items() if name not in others}
    about |= {name: list(value) for name, value in about.items() if isinstance(value, tuple)}
    if is_complete(root, about, COMPLETE, "a flight with other settings,", "jobs/fly.py"):
        console.print(f"{root} is complete already; nothing to do")
        return root
    begin(root, about)
    numbers = range(settings.photos)
    missing = [number for number in numbers if not _part(root, number).exists()]
    with progress(len(missing), "fly", "photos") as meter:
        for _ in _take_photos(settings, root, missing):
            meter.advance()
    rows = [json_files.read_checksummed(str(_part(root, number)))["row"] for number in numbers]
    write_table(root / TABLE, rows)
    json_files.write_checksummed(str(root / COMPLETE), about)
    storage.remove_folder(str(root / ".parts"))
    console.print(f"{root}: {settings.photos} photos over {settings.mosaic}", markup=False)
    return root


def _take_photos(settings: MapFlightSettings, root: Path, numbers: list[int]) -> Iterator[None]:
    if settings.workers == 0:
        for number in numbers:
            write_photo(settings, str(root), number)
            yield
        return
    cluster.connect()
    task, window = ray.remote(num_cpus=1)(write_photo), settings.workers or 2 * cluster.cpus()
    submit = partial(task.remote, settings, str(root))
    for _ in cluster.bounded_map(submit, numbers, window):
        yield None


def write_photo(settings: MapFlightSettings, root: str, number: int) -> None:
    """Take one photo and write it, then the part with its row."""
    taken = photo_over_map(settings, number)
    name = f"photos/{number:05d}.jpg"
    storage.write_bytes(str(Path(root) / name), taken.jpeg)
    row = {
        "path": name,
        "location": f"{number:05d}",
        "lat": f"{taken.lat:.8f}",
        "lon": f"{taken.lon:.8f}",
        "altitude_m": f"{taken.pose.altitude_m:.2f}",
        "heading_deg": f"{taken.pose.heading_deg:.2f}",
        "pitch_deg": f"{taken.pose.pitch_deg:.2f}",
    }
    json_files.write_checksummed(str(_part(Path(root), number)), {"row": row})


def _part(root: Path, number: int) -> Path:
    return root / ".parts" / f"{number:05d}.json"
