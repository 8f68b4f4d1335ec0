"""One location's pictures in University-1652's folders, and the tables beside them.

A folder of pictures appears whole, under its name; a part file, written last, says that the
location is complete.
"""

import csv
import io
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pipeline.core import json_files, storage
from pipeline.core.errors import InputError
from pipeline.simulation.location import (
    LocationImages,
    LocationSpec,
    geotag,
    offset_latlon,
    render_location,
)

Role = Literal["train", "test", "distractor"]
LAYOUT: dict[Role, tuple[str, ...]] = {
    "train": ("train/{view}",),
    "test": ("test/query_{view}", "test/gallery_{view}"),
    "distractor": ("test/gallery_{view}",),
}
"""Folders that hold a location's pictures: written to the first, linked from the others."""


@dataclass(frozen=True, kw_only=True)
class LocationJob:
    """One location to be made by one task."""

    root: str
    role: Role
    order: LocationSpec

    @property
    def name(self) -> str:
        return f"{self.order.location:04d}"


def write_location(job: LocationJob) -> dict[str, float]:
    """Take and place all pictures of a location, then its part file; seconds spent by step.

    Whatever an earlier, broken attempt left of the location is replaced.
    """
    taken = render_location(job.order)
    first, *others = LAYOUT[job.role]
    names = {
        "satellite": {f"{job.name}.jpg": taken.satellite},
        "drone": {f"image-{i:02d}.jpeg": data for i, data in enumerate(taken.drone, 1)},
    }
    for view, files in names.items():
        folder = _create_hidden_folder(Path(job.root), first.format(view=view), job.name)
        for name, data in files.items():
            (folder / name).write_bytes(data)
        home = _publish_folder(folder)
        for other in others:
            folder = _create_hidden_folder(Path(job.root), other.format(view=view), job.name)
            for name in files:
                _link_or_copy(home / name, folder / name)
            _publish_folder(folder)
    json_files.write_checksummed(str(part_path(job)), {"poses": _pose_rows(job, taken)})
    return taken.seconds


def _create_hidden_folder(root: Path, below: str, name: str) -> Path:
    """An empty folder beside the one that it will become: hidden, so that readers pass it over."""
    folder = root / below / f".{name}"
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    return folder


def _publish_folder(folder: Path) -> Path:
    """Give the folder its name: all its pictures appear at once."""
    home = folder.with_name(folder.name[1:])
    if home.exists():
        shutil.rmtree(home)
    return folder.rename(home)


def _link_or_copy(file: Path, link: Path) -> None:
    try:
        os.link(file, link)
    except OSError:  # a file system without hard links
        shutil.copyfile(file, link)


def part_path(job: LocationJob) -> Path:
    """The file that says that a location is complete."""
    return Path(job.root) / ".parts" / f"{job.name}.json"


def _pose_rows(job: LocationJob, taken: LocationImages) -> list[dict[str, Any]]:
    """Rows of `poses.csv`: each picture under each of its paths."""
    lat, lon = geotag(job.order.location)
    rows = []
    for folder in LAYOUT[job.role]:
        for i, pose in enumerate(taken.poses, 1):
            camera_lat, camera_lon = offset_latlon(lat, lon, pose.x_m, pose.y_m)
            rows.append(
                {
                    "path": f"{folder.format(view='drone')}/{job.name}/image-{i:02d}.jpeg",
                    "location": job.name,
                    "lat": f"{camera_lat:.7f}",
                    "lon": f"{camera_lon:.7f}",
                    "altitude_m": f"{pose.altitude_m:.2f}",
                    "heading_deg": f"{pose.heading_deg:.2f}",
                    "pitch_deg": f"{pose.pitch_deg:.2f}",
                    "fov_deg": f"{pose.fov_deg:.2f}",
                }
            )
    return rows


def _read_poses(path: Path) -> list[dict[str, Any]]:
    try:
        poses: list[dict[str, Any]] = json_files.read_checksummed(str(path))["poses"]
    except (KeyError, ValueError) as error:
        raise InputError(
            f"{path} is damaged ({error!r}), expected the poses of a location; delete it and run jobs/simulate.py again"
        ) from None
    return poses


def write_tables(root: Path, jobs: list[LocationJob]) -> None:
    """Write `locations.csv` and `poses.csv`, once all locations are there.

    Raises InputError where a location's part is not what was written.
    """
    ordered = sorted(jobs, key=lambda job: job.order.location)
    places = []
    for job in ordered:
        lat, lon = geotag(job.order.location)
        places.append({"location": job.name, "lat": f"{lat:.7f}", "lon": f"{lon:.7f}"})
    poses = [row for job in ordered for row in _read_poses(part_path(job))]
    for name, rows in (
        ("locations.csv", places),
        ("poses.csv", sorted(poses, key=lambda row: str(row["path"]))),
    ):
        text = io.StringIO()
        writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        storage.write_bytes(str(root / name), text.getvalue().encode())
