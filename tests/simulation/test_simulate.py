"""The stage: layout, determinism, resume, rejections; colour alone must not find a location."""

import csv
import hashlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import simplejpeg
from PIL import Image

from pipeline.core import cluster
from pipeline.core.errors import InputError
from pipeline.simulation.layout import write_location
from pipeline.simulation.location import LocationSpec, render_location
from pipeline.simulation.settings import Flight, SimulationSettings
from pipeline.simulation.simulate import plan_jobs, simulate


def settings(out: Path, **changed: Any) -> SimulationSettings:
    small: dict[str, Any] = {
        "train_locations": 2,
        "test_locations": 2,
        "distractors": 1,
        "views": 3,
        "size": 32,
    }
    return SimulationSettings(out=str(out), **(small | changed))


def digest(root: Path) -> dict[str, str]:
    files = (path for path in sorted(root.rglob("*")) if path.is_file())
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files
    }


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> Callable[[int | None], None]:
    """Run tasks here, in reverse order, without Ray; `in_process(n)` interrupts after n tasks."""

    def use(stop_after: int | None) -> None:
        def bounded(submit: object, items: Iterable[Any], window: int) -> Iterator[tuple[Any, Any]]:
            for done, job in enumerate(reversed(list(items))):
                if done == stop_after:
                    raise KeyboardInterrupt
                yield job, write_location(job)

        monkeypatch.setattr(cluster, "bounded_map", bounded)
        monkeypatch.setattr(cluster, "connect", lambda: None)
        monkeypatch.setattr(cluster, "cpus", lambda: 1)

    use(None)
    return use


def test_simulate_writes_university1652_same_bytes_on_ray(
    tmp_path: Path, ray_cluster: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = simulate(settings(tmp_path / "by_ray"))
    with monkeypatch.context() as patch:
        patch.setattr(
            cluster,
            "bounded_map",
            lambda submit, items, window: ((job, write_location(job)) for job in items),
        )
        simulate(settings(tmp_path / "here"))
    assert digest(root) == digest(tmp_path / "here")

    def ids(folder: str) -> list[str]:
        return sorted(path.name for path in (root / folder).iterdir())

    train, query, gallery = ids("train/drone"), ids("test/query_drone"), ids("test/gallery_drone")
    assert sorted(train + gallery) == ["0001", "0002", "0003", "0004", "0005"]
    assert (len(train), len(query), len(gallery)) == (2, 2, 3)
    assert set(query) < set(gallery)
    assert ids("train/satellite") == train
    assert ids("test/query_satellite") == query
    assert ids("test/gallery_satellite") == gallery
    for folder, name in [("query", query[0]), ("gallery", query[0])]:
        drone = root / f"test/{folder}_drone/{name}"
        assert sorted(path.name for path in drone.iterdir()) == [
            "image-01.jpeg",
            "image-02.jpeg",
            "image-03.jpeg",
        ]
        assert [path.name for path in (root / f"test/{folder}_satellite/{name}").iterdir()] == [
            f"{name}.jpg"
        ]
    one = (root / f"test/query_drone/{query[0]}/image-02.jpeg").read_bytes()
    assert one == (root / f"test/gallery_drone/{query[0]}/image-02.jpeg").read_bytes()
    with Image.open(root / f"train/satellite/{train[0]}/{train[0]}.jpg") as image:
        assert (image.size, image.format) == ((32, 32), "JPEG")
    assert not (root / ".parts").exists()


def test_tables_hold_every_location_and_every_uav_image(
    tmp_path: Path, in_process: Callable[[int | None], None]
) -> None:
    root = simulate(settings(tmp_path / "out"))
    with (root / "locations.csv").open() as stream:
        locations = {row["location"]: row for row in csv.DictReader(stream)}
    with (root / "poses.csv").open() as stream:
        poses = list(csv.DictReader(stream))
    assert sorted(locations) == ["0001", "0002", "0003", "0004", "0005"]
    on_disk = sorted(str(path.relative_to(root)) for path in root.rglob("image-*.jpeg"))
    assert sorted(row["path"] for row in poses) == on_disk
    for row in poses:
        location, down = locations[row["location"]], np.radians(-float(row["pitch_deg"]))
        north = (float(row["lat"]) - float(location["lat"])) * 111_320
        away = float(row["altitude_m"]) / np.tan(down)
        assert north == pytest.approx(
            -away * np.cos(np.radians(float(row["heading_deg"]))), abs=0.2
        )


@pytest.mark.slow
def test_interrupted_run_resumes_without_partial_locations(
    tmp_path: Path, in_process: Callable[[int | None], None]
) -> None:
    intact = simulate(settings(tmp_path / "intact"))
    broken = tmp_path / "broken"
    in_process(2)
    with pytest.raises(KeyboardInterrupt):
        simulate(settings(broken))
    assert len(list((broken / ".parts").glob("0*.json"))) == 2
    # A kill in the middle of a location leaves some images under a hidden name, and one folder
    # without its part.
    first = plan_jobs(settings(broken), str(broken), [])[0]
    (broken / "train/drone" / f".{first.name}").mkdir(parents=True)
    (broken / "train/drone" / f".{first.name}" / "image-01.jpeg").write_bytes(b"half")
    (broken / "train/satellite" / first.name).mkdir(parents=True)
    kept = {
        path: path.stat().st_mtime_ns
        for path in broken.rglob("image-*.jpeg")
        if path.parent.name[0] != "."
    }
    in_process(None)
    simulate(settings(broken))
    assert digest(broken) == digest(intact)
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in kept.items())


def test_complete_data_set_is_kept_other_settings_rejected(
    tmp_path: Path, in_process: Callable[[int | None], None], capsys: pytest.CaptureFixture[str]
) -> None:
    root = simulate(settings(tmp_path / "out"))
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    in_process(0)
    assert simulate(settings(tmp_path / "out")) == root
    assert {path: path.stat().st_mtime_ns for path in root.rglob("*")} == before
    assert "complete already" in capsys.readouterr().err
    with pytest.raises(
        InputError, match="made with views 3 instead of 5, expected the same settings"
    ):
        simulate(settings(tmp_path / "out", views=5))


def test_folder_with_other_files_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(InputError, match="holds files that no simulation wrote"):
        simulate(settings(tmp_path))


def test_textures_are_used_once_each_and_too_few_rejected(
    tmp_path: Path, in_process: Callable[[int | None], None]
) -> None:
    folder = tmp_path / "textures"
    folder.mkdir()
    for i in range(6):
        Image.new("RGB", (64, 64), (40 * i, 90, 80)).save(folder / f"{i}.png")
    names = [str(path) for path in sorted(folder.iterdir())]
    jobs = plan_jobs(settings(tmp_path / "out", textures=str(folder)), "root", names)
    assert len({job.spec.texture for job in jobs}) == len(jobs) == 5
    assert simulate(
        settings(tmp_path / "out", textures=str(folder), train_locations=1, test_locations=1)
    ).exists()
    with pytest.raises(InputError, match="6 usable images for 13 locations; expected one each"):
        simulate(settings(tmp_path / "more", textures=str(folder), train_locations=10))
    filled = settings(
        tmp_path / "filled", textures=str(folder), train_locations=10, fill_with_towns=True
    )
    used = [job.spec.texture for job in plan_jobs(filled, "root", names)]
    assert sorted(filter(None, used)) == names
    assert used.count(None) == 13 - 6


def test_free_flight_has_other_views_of_the_same_place() -> None:
    spiral, free = (
        render_location(LocationSpec(seed=4, location=2, views=3, size=64, flight=flight))
        for flight in get_args(Flight)
    )
    assert spiral.satellite == free.satellite
    assert spiral.drone != free.drone
    assert len({round(pose.pitch_deg) for pose in free.poses}) > 1
    again = render_location(LocationSpec(seed=4, location=2, views=3, size=64, flight="free"))
    assert again.drone == free.drone


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"views": 0}, "--views is 0, expected 1 or more"),
        ({"views": 54_000}, "--views is 54000, expected at most 10000"),
        ({"distractors": 160_000_000}, "locations asked for, expected at most 1000000"),
        ({"size": 4000}, "--size is 4000, expected 32 to 1024 pixels"),
        ({"train_locations": -1}, "--train-locations is -1, expected 0 or more"),
        ({"train_locations": 0, "test_locations": 0, "distractors": 0}, "no locations asked for"),
    ],
)
def test_invalid_settings_are_rejected(tmp_path: Path, wrong: dict[str, int], message: str) -> None:
    with pytest.raises(InputError, match=message):
        settings(tmp_path, **wrong)


def test_output_that_is_no_folder_is_rejected() -> None:
    with pytest.raises(InputError, match="expected a local or mounted folder"):
        simulate(
            SimulationSettings(out="memory://x", train_locations=1, test_locations=0, distractors=0)
        )


@pytest.mark.slow
def test_mean_colour_alone_does_not_find_the_location() -> None:
    satellites, drones = [], []
    for location in range(1, 41):
        images = render_location(LocationSpec(seed=5, location=location, views=2, size=32))
        satellites.append(mean_colour(images.satellite))
        drones.append([mean_colour(data) for data in images.drone])
    gallery, queries = np.array(satellites), np.array(drones)
    nearest = np.argmin(np.linalg.norm(queries[:, :, None] - gallery, axis=3), axis=2)
    found = (nearest == np.arange(40)[:, None]).mean()
    assert found < 0.2  # by chance 0.025


def mean_colour(jpeg: bytes) -> np.ndarray:
    mean: np.ndarray = simplejpeg.decode_jpeg(jpeg, colorspace="RGB").mean(axis=(0, 1))
    return mean
