"""Simulated flights: settings come in, a made data set in University-1652's layout goes out.

    train/{satellite,drone}/<id>/              locations to learn from
    test/query_{satellite,drone}/<id>/         the test's queries
    test/gallery_{satellite,drone}/<id>/       the same pictures again, and those of the distractors
    locations.csv                              location, lat, lon
    poses.csv                                  one row per UAV picture: its path, and where and how it was taken
    simulation.json                            the settings; written last: where it is, the data set is complete

A location is one Ray task. It leaves `.parts/<id>.json` when all its pictures are in place, so a
run that was stopped goes on where it was. Pictures are written to a local or mounted path, since
galleries share files with queries.
"""

import hashlib
import shutil
from collections import Counter
from dataclasses import asdict
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
from pipeline.simulation.settings import SimulationSettings
from pipeline.simulation.texture import usable_textures


@locks_output(lambda settings: settings.out)
def simulate(settings: SimulationSettings) -> Path:
    """Make the data set, or what is missing of it; its folder.

    Raises InputError for textures that do not suffice and for a folder that holds something else.
    """
    if not storage.is_local(settings.out):
        raise InputError(
            f"--out is {settings.out}; expected a local or mounted folder; make it there and copy it"
        )
    root = Path(storage.resolve(settings.out)[1]).absolute()
    # Tasks may run in another working directory, so they are given whole paths.
    textures, passed_over = (
        usable_textures(storage.absolute(settings.textures)) if settings.textures else ([], 0)
    )
    described = _settings_metadata(settings, textures)
    if _is_complete(root, described):
        shutil.rmtree(
            root / ".parts", ignore_errors=True
        )  # of a run that was killed between its last two steps
        console.print(f"{root} is complete already; nothing to do")
        return root
    jobs = plan_jobs(settings, str(root), textures)
    if passed_over:
        console.print(
            f"{settings.textures}: {passed_over} files are no usable images and were passed over"
        )
    (root / ".parts").mkdir(parents=True, exist_ok=True)
    json_files.write_checksummed(str(root / ".parts" / "settings.json"), described)
    todo = [job for job in jobs if not part_path(job).exists()]
    spent = _run_jobs(todo, len(jobs), settings.views + 1)
    write_tables(root, jobs)
    json_files.write_checksummed(str(root / "simulation.json"), described)
    shutil.rmtree(root / ".parts")
    share = ", ".join(f"{step} {seconds:.1f} s" for step, seconds in spent.items())
    console.print(f"{root}: {len(jobs)} locations ({share or 'all were there'}, over all cores)")
    return root


def plan_jobs(settings: SimulationSettings, root: str, textures: list[str]) -> list[LocationJob]:
    """One job per location. Numbers are dealt out at random, so that they say nothing about the
    role.
    """
    roles: list[Role] = ["train"] * settings.train_locations
    roles += ["test"] * settings.test_locations
    roles += ["distractor"] * settings.distractors
    if settings.textures and len(textures) < len(roles):
        raise InputError(
            f"{settings.textures} holds {len(textures)} usable images for {len(roles)} locations; "
            "expected one each; add images or ask for fewer locations"
        )
    rng = np.random.default_rng([settings.seed, 0])
    numbers = rng.permutation(len(roles)) + 1
    dealt = rng.permutation(len(textures)) if textures else None
    return [
        LocationJob(
            root=root,
            role=role,
            order=LocationSpec(
                seed=settings.seed,
                location=int(number),
                views=settings.views,
                size=settings.size,
                texture=None if dealt is None else textures[int(dealt[int(number) - 1])],
                texture_metres_per_pixel=settings.texture_metres_per_pixel,
            ),
        )
        for role, number in zip(roles, numbers, strict=True)
    ]


def _run_jobs(todo: list[LocationJob], total: int, pictures: int) -> Counter[str]:
    """Run the jobs over the cluster; seconds spent by step, over all of them."""
    spent: Counter[str] = Counter()
    if not todo:
        return spent
    cluster.connect()
    task = ray.remote(num_cpus=1)(write_location)
    with progress(len(todo) * pictures, "simulate", "images") as meter:
        if len(todo) < total:
            meter.note(f"{total - len(todo)} of {total} locations are there already")
        for _, seconds in cluster.bounded_map(task.remote, todo, window=2 * cluster.cpus()):
            spent.update(seconds)
            meter.advance(pictures)
    return spent


def _settings_metadata(settings: SimulationSettings, textures: list[str]) -> dict[str, Any]:
    """What the data set depends on; where it lies, and where its textures lie, is no part of it."""
    described = {
        name: value for name, value in asdict(settings).items() if name not in ("out", "textures")
    }
    if settings.textures:
        names = "\n".join(
            str(Path(path).relative_to(storage.absolute(settings.textures))) for path in textures
        )
        described["textures"] = (
            f"{len(textures)} images, {hashlib.sha256(names.encode()).hexdigest()[:16]}"
        )
    return described


def _is_complete(root: Path, described: dict[str, Any]) -> bool:
    """Whether this very data set is there.

    Raises InputError when the folder holds another one, or something else.
    """
    complete, begun = root / "simulation.json", root / ".parts" / "settings.json"
    there = complete if complete.exists() else begun
    if not there.exists():
        if root.exists() and any(root.iterdir()):
            raise InputError(
                f"{root} holds files that no simulation wrote; expected a new or empty folder; choose another --out"
            )
        return False
    try:
        found = json_files.read_checksummed(str(there))
    except ValueError as error:
        raise InputError(
            f"{there} is damaged ({error}), expected the settings of a simulation; remove {root} and run jobs/simulate.py again"
        ) from None
    other = [
        f"{name} {found.get(name)!r} instead of {described.get(name)!r}"
        for name in sorted({*found, *described})
        if found.get(name) != described.get(name)
    ]
    if other:
        raise InputError(
            f"{root} holds a data set made with {', '.join(other)}; expected the same settings to go on; "
            "choose another --out or remove the folder"
        )
    return there == complete
