"""A location's images in University-1652's folders, and the tables of all locations.

A folder of images is published by renaming it, so it is complete when it appears; the part file,
written last, marks the location as complete.
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
"""Folders of a location's images: written to the first, hard links in the others."""


@dataclass(frozen=True, kw_only=True)
class LocationJob:
    """One location, rendered and written by one task."""

    root: str
    role: Role
    spec: LocationSpec

    @property
    def name(self) -> str:
        return f"{self.spec.location:04d}"


def write_location(job: LocationJob) -> dict[str, float]:
    """Render and write a location's images, then its part file; seconds spent per step.

    Replaces what an interrupted attempt has left of the location.
    """
    images = render_location(job.spec)
    first, *others = LAYOUT[job.role]
    names = {
        "satellite": {f"{job.name}.jpg": images.satellite},
        "drone": {f"image-{i:02d}.jpeg": data for i, data in enumerate(images.drone, 1)},
    }
    for view, files in names.items():
        folder = _create_hidden_folder(Path(job.root), first.format(view=view), job.name)
        for name, data in files.items():
            (folder / name).write_bytes(data)
        published = _publish_folder(folder)
        for other in others:
            folder = _create_hidden_folder(Path(job.root), other.format(view=view), job.name)
            for name in files:
                _link_or_copy(published / name, folder / name)
            _publish_folder(folder)
    json_files.write_checksummed(str(part_path(job)), {"poses": _pose_rows(job, images)})
    return images.seconds


def _create_hidden_folder(root: Path, below: str, name: str) -> Path:
    """An empty hidden folder beside its final path: readers skip hidden folders."""
    folder = root / below / f".{name}"
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    return folder


def _publish_folder(folder: Path) -> Path:
    """Rename the folder to its final path: all its images appear at once."""
    final = folder.with_name(folder.name[1:])
    if final.exists():
        shutil.rmtree(final)
    return folder.rename(final)


def _link_or_copy(file: Path, link: Path) -> None:
    try:
        os.link(file, link)
    except OSError:  # a file system without hard links
        shutil.copyfile(file, link)


def part_path(job: LocationJob) -> Path:
    """The file whose presence means that a location is complete."""
    return Path(job.root) / ".parts" / f"{job.name}.json"


def _pose_rows(job: LocationJob, images: LocationImages) -> list[dict[str, Any]]:
    """Rows of `poses.csv`: one per image and path, as hard links give an image two paths."""
    lat, lon = geotag(job.spec.location)
    rows = []
    for folder in LAYOUT[job.role]:
        for i, pose in enumerate(images.poses, 1):
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
            f"{path} is damaged ({error!r}), expected the poses of a location; delete it and run "
            "jobs/simulate.py again"
        ) from None
    return poses


def write_tables(root: Path, jobs: list[LocationJob]) -> None:
    """Write `locations.csv` and `poses.csv` when all locations are complete.

    Raises InputError if a location's part file is damaged.
    """
    ordered = sorted(jobs, key=lambda job: job.spec.location)
    locations = []
    for job in ordered:
        lat, lon = geotag(job.spec.location)
        locations.append({"location": job.name, "lat": f"{lat:.7f}", "lon": f"{lon:.7f}"})
    poses = [row for job in ordered for row in _read_poses(part_path(job))]
    for name, rows in (
        ("locations.csv", locations),
        ("poses.csv", sorted(poses, key=lambda row: str(row["path"]))),
    ):
        write_table(root / name, rows)


def write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows as CSV, atomically; their columns are the first one's keys."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    storage.write_bytes(str(path), text.getvalue().encode())
