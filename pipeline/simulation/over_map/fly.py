"""The stage of a simulated flight over a map: settings come in, photos and their table go out.

    photos/<number>.jpg    JPEGs with heading, pitch, height and lens in their tags, as sensors err
    photos.csv             path, location, lat, lon, altitude_m, heading_deg, pitch_deg: the truth,
                           as `make_shards --source table` reads it
    flight.json            the settings; written last

Each photo is one task, and a rerun resumes with the missing ones.
"""

import csv
import io
from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import ray

from pipeline.core import cluster, json_files, storage
from pipeline.core.errors import InputError
from pipeline.core.lock import locks_output
from pipeline.core.progress import console, progress
from pipeline.simulation.over_map.photo import photo_over_map
from pipeline.simulation.over_map.settings import MapFlightSettings

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
    about = {
        name: value for name, value in asdict(settings).items() if name not in ("out", "workers")
    }
    about = {
        name: list(value) if isinstance(value, tuple) else value for name, value in about.items()
    }
    if _is_complete(root, about):
        console.print(f"{root} is complete already; nothing to do")
        return root
    (root / "photos").mkdir(parents=True, exist_ok=True)
    (root / ".parts").mkdir(exist_ok=True)
    settings_file = root / ".parts" / "settings.json"
    if settings_file.exists() and _read(settings_file) != about:
        raise InputError(
            f"{root} holds a part of another flight, expected an empty folder or one of these "
            "settings; name another --out"
        )
    json_files.write_checksummed(str(settings_file), about)
    numbers = range(settings.photos)
    missing = [number for number in numbers if not _part(root, number).exists()]
    with progress(len(missing), "fly", "photos") as meter:
        for _ in _take_photos(settings, root, missing):
            meter.advance()
    rows = [json_files.read_checksummed(str(_part(root, number)))["row"] for number in numbers]
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    storage.write_bytes(str(root / TABLE), text.getvalue().encode())
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


def _is_complete(root: Path, about: dict[str, Any]) -> bool:
    """Raises InputError where the folder holds another flight."""
    done = root / COMPLETE
    if not done.exists():
        return False
    if _read(done) != about:
        raise InputError(
            f"{root} holds a flight with other settings, expected an empty folder or one of these; "
            "name another --out"
        )
    return True


def _read(path: Path) -> dict[str, Any] | None:
    """The settings in a file; None where it is damaged."""
    try:
        return json_files.read_checksummed(str(path))
    except ValueError:
        return None
