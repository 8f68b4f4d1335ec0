"""The stage: layout, determinism, restart, refusals; and that colour alone does not find the place."""

import csv
import hashlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
from PIL import Image

from pipeline.core import cluster
from pipeline.core.errors import InputError
from pipeline.simulation.layout import write_location
from pipeline.simulation.location import LocationSpec, render_location
from pipeline.simulation.settings import SimulationSettings
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
    """Run the tasks here, in reverse order, without Ray; `in_process(n)` pulls the plug after n of
    them.
    """

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


def test_the_folders_are_university_1652s_and_the_bytes_the_same_whatever_the_parallelism(
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
    with Image.open(root / f"train/satellite/{train[0]}/{train[0]}.jpg") as picture:
        assert (picture.size, picture.format) == ((32, 32), "JPEG")
    assert not (root / ".parts").exists()


def test_geotags_name_every_location_and_every_uav_picture(
    tmp_path: Path, in_process: Callable[[int | None], None]
) -> None:
    root = simulate(settings(tmp_path / "out"))
    with (root / "locations.csv").open() as stream:
        places = {row["location"]: row for row in csv.DictReader(stream)}
    with (root / "poses.csv").open() as stream:
        poses = list(csv.DictReader(stream))
    assert sorted(places) == ["0001", "0002", "0003", "0004", "0005"]
    on_disk = sorted(str(path.relative_to(root)) for path in root.rglob("image-*.jpeg"))
    assert sorted(row["path"] for row in poses) == on_disk
    for row in poses:
        place, down = places[row["location"]], np.radians(-float(row["pitch_deg"]))
        north = (float(row["lat"]) - float(place["lat"])) * 111_320
        away = float(row["altitude_m"]) / np.tan(down)
        assert north == pytest.approx(
            -away * np.cos(np.radians(float(row["heading_deg"]))), abs=0.2
        )


def test_a_run_that_was_stopped_goes_on_and_leaves_no_half_location(
    tmp_path: Path, in_process: Callable[[int | None], None]
) -> None:
    whole = simulate(settings(tmp_path / "whole"))
    broken = tmp_path / "broken"
    in_process(2)
    with pytest.raises(KeyboardInterrupt):
        simulate(settings(broken))
    assert len(list((broken / ".parts").glob("0*.json"))) == 2
    # What a kill in the middle of a location leaves: some pictures under a hidden name, one folder
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
    assert digest(broken) == digest(whole)
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in kept.items())


def test_a_finished_data_set_is_left_alone_and_other_settings_are_refused(
    tmp_path: Path, in_process: Callable[[int | None], None], capsys: pytest.CaptureFixture[str]
) -> None:
    root = simulate(settings(tmp_path / "out"))
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    in_process(0)
    assert simulate(settings(tmp_path / "out")) == root
    assert {path: path.stat().st_mtime_ns for path in root.rglob("*")} == before
    assert "complete already" in capsys.readouterr().err
    with pytest.raises(
        InputError, match="made with views 3 instead of 5; expected the same settings"
    ):
        simulate(settings(tmp_path / "out", views=5))


def test_a_folder_with_other_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(InputError, match="holds files that no simulation wrote"):
        simulate(settings(tmp_path))


def test_textures_are_dealt_out_one_each_and_too_few_are_refused(
    tmp_path: Path, in_process: Callable[[int | None], None]
) -> None:
    folder = tmp_path / "textures"
    folder.mkdir()
    for i in range(6):
        Image.new("RGB", (64, 64), (40 * i, 90, 80)).save(folder / f"{i}.png")
    names = [str(path) for path in sorted(folder.iterdir())]
    jobs = plan_jobs(settings(tmp_path / "out", textures=str(folder)), "root", names)
    assert len({job.order.texture for job in jobs}) == len(jobs) == 5
    assert simulate(
        settings(tmp_path / "out", textures=str(folder), train_locations=1, test_locations=1)
    ).exists()
    with pytest.raises(InputError, match="6 usable images for 13 locations; expected one each"):
        simulate(settings(tmp_path / "more", textures=str(folder), train_locations=10))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"views": 0}, "--views is 0; expected 1 or more"),
        ({"views": 54_000}, "--views is 54000; expected at most 10000"),
        ({"distractors": 160_000_000}, "locations asked for; expected at most 1000000"),
        ({"size": 4000}, "--size is 4000; expected 32 to 1024 pixels"),
        ({"train_locations": -1}, "--train-locations is -1; expected 0 or more"),
        ({"train_locations": 0, "test_locations": 0, "distractors": 0}, "no locations asked for"),
    ],
)
def test_settings_that_make_no_data_set_are_refused(
    tmp_path: Path, wrong: dict[str, int], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        settings(tmp_path, **wrong)


def test_an_address_that_is_no_folder_is_refused() -> None:
    with pytest.raises(InputError, match="expected a local or mounted folder"):
        simulate(
            SimulationSettings(out="memory://x", train_locations=1, test_locations=0, distractors=0)
        )


def test_mean_colour_alone_does_not_find_the_place() -> None:
    satellites, drones = [], []
    for location in range(1, 41):
        taken = render_location(LocationSpec(seed=5, location=location, views=2, size=32))
        satellites.append(mean_colour(taken.satellite))
        drones.append([mean_colour(data) for data in taken.drone])
    gallery, queries = np.array(satellites), np.array(drones)
    nearest = np.argmin(np.linalg.norm(queries[:, :, None] - gallery, axis=3), axis=2)
    found = (nearest == np.arange(40)[:, None]).mean()
    assert found < 0.2  # by chance 0.025


def mean_colour(jpeg: bytes) -> np.ndarray:
    mean: np.ndarray = simplejpeg.decode_jpeg(jpeg, colorspace="RGB").mean(axis=(0, 1))
    return mean
