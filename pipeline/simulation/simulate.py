"""The simulation stage: settings come in, a data set in University-1652's layout goes out.

    train/{satellite,drone}/<id>/              locations to train on
    test/query_{satellite,drone}/<id>/         the queries of the test
    test/gallery_{satellite,drone}/<id>/       the same images again, and those of the distractors
    locations.csv                              location, lat, lon
    poses.csv                                  one row per UAV image: its path and its camera pose
    simulation.json                            the settings; written last, so its presence means
                                               that the data set is complete

Each location is one task, of Ray or in this process. The task writes `.parts/<id>.json` after all
images of its location, so a rerun resumes with the missing locations. The output is a local or
mounted path, because the galleries hold hard links to the queries' files.
"""

import hashlib
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import ray

from pipeline.core import cluster, json_files, storage
from pipeline.core.errors import InputError
from pipeline.core.lock import locks_output
from pipeline.core.progress import console, progress
from pipeline.simulation.layout import LocationJob, Role, part_path, write_location, write_tables
from pipeline.simulation.location import LocationSpec
from pipeline.simulation.resume import begin, is_complete, local_root, settings_record
from pipeline.simulation.settings import SimulationSettings
from pipeline.simulation.texture import usable_textures

IMAGE_S = 0.1
"About what an image takes a core: fewer of them do not wait for Ray."
COMPLETE = "simulation.json"


@locks_output(lambda settings: settings.out)
def simulate(settings: SimulationSettings) -> Path:
    """Write the data set, or its missing locations; the folder.

    Raises InputError for too few textures, and for a folder that holds something else.
    """
    root = local_root(settings.out)
    # Absolute paths: tasks may run in another working directory.
    textures, skipped = (
        usable_textures(storage.absolute(settings.textures)) if settings.textures else ([], 0)
    )
    metadata = _settings_metadata(settings, textures)
    if is_complete(root, metadata, COMPLETE, "a data set", "jobs/simulate.py"):
        # A run that was killed between its last two steps leaves its parts.
        shutil.rmtree(root / ".parts", ignore_errors=True)
        console.print(f"{root} is complete already; nothing to do")
        return root
    jobs = plan_jobs(settings, str(root), textures)
    if skipped:
        console.print(f"{settings.textures}: skipped {skipped} files that are no usable images")
    begin(root, metadata)
    missing = [job for job in jobs if not part_path(job).exists()]
    seconds = _run_jobs(missing, len(jobs), settings)
    write_tables(root, jobs)
    json_files.write_checksummed(str(root / COMPLETE), metadata)
    shutil.rmtree(root / ".parts")
    shares = ", ".join(f"{step} {spent:.1f} s" for step, spent in seconds.items())
    console.print(
        f"{root}: {len(jobs)} locations ({shares or 'all existed already'}, over all cores)"
    )
    return root


def plan_jobs(settings: SimulationSettings, root: str, textures: list[str]) -> list[LocationJob]:
    """One job per location; random numbers, so that a location's number does not tell its role."""
    roles: list[Role] = ["train"] * settings.train_locations
    roles += ["test"] * settings.test_locations
    roles += ["distractor"] * settings.distractors
    if settings.textures and len(textures) < len(roles) and not settings.fill_with_towns:
        raise InputError(
            f"{settings.textures} holds {len(textures)} usable images for {len(roles)} locations; "
            "expected one each; add images, ask for fewer locations, or set --fill-with-towns"
        )
    rng = np.random.default_rng([settings.seed, 0])
    numbers = rng.permutation(len(roles)) + 1
    # By the location's number; a number beyond the images is a town's.
    texture_of = dict(enumerate((textures[at] for at in rng.permutation(len(textures))), start=1))
    return [
        LocationJob(
            root=root,
            role=role,
            spec=LocationSpec(
                seed=settings.seed,
                location=int(number),
                views=settings.views,
                size=settings.size,
                flight=settings.flight,
                texture=texture_of.get(int(number)),
                texture_metres_per_pixel=settings.texture_metres_per_pixel,
            ),
        )
        for role, number in zip(roles, numbers, strict=True)
    ]


def _run_jobs(missing: list[LocationJob], total: int, settings: SimulationSettings) -> Counter[str]:
    """Run the jobs; seconds spent per step, summed over all jobs."""
    spent: Counter[str] = Counter()
    if not missing:
        return spent
    images = settings.views + 1
    with progress(len(missing) * images, "simulate", "images") as meter:
        if len(missing) < total:
            meter.note(f"{total - len(missing)} of {total} locations exist already")
        workers = cluster.workers_for(settings.workers, len(missing) * images * IMAGE_S)
        for seconds in _write_locations(missing, workers):
            spent.update(seconds)
            meter.advance(images)
    return spent


def _write_locations(jobs: list[LocationJob], workers: int | None) -> Iterator[dict[str, float]]:
    """Seconds per step of each job, as they finish."""
    if workers == 0:
        yield from map(write_location, jobs)
        return
    cluster.connect()
    task, window = ray.remote(num_cpus=1)(write_location), workers or 2 * cluster.cpus()
    for _, seconds in cluster.bounded_map(task.remote, jobs, window):
        yield seconds


def _settings_metadata(settings: SimulationSettings, textures: list[str]) -> dict[str, Any]:
    """The settings that determine the data set's content: without folders and workers."""
    metadata = settings_record(settings, ("out", "textures", "workers"))
    if settings.textures:
        folder = storage.absolute(settings.textures)
        names = "\n".join(str(Path(path).relative_to(folder)) for path in textures)
        digest = hashlib.sha256(names.encode()).hexdigest()[:16]
        metadata["textures"] = f"{len(textures)} images, {digest}"
    return metadata
