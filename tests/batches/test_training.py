"""What training sees, and when: planners by invariants, batches from small shards made here.

Shapes: B images, H x W pixels.
"""

import io
import json
import tarfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from itertools import count
from pathlib import Path
from threading import Event

import numpy as np
import pytest
import webdataset
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from pipeline.batches.ordered import decode_samples
from pipeline.batches.sampler import Span, plan_pass, read_spans
from pipeline.batches.training import Batch, StreamConfig, TrainingStream
from pipeline.core import json_files, storage
from pipeline.core.errors import InputError
from pipeline.core.prefetch import prefetch, prefetch_map
from pipeline.core.records import ImageRecord, Split, View
from pipeline.images.decode import DecodeError, decode
from pipeline.images.transforms import Augmentation
from pipeline.shards.manifest import MANIFEST, Manifest, Shard
from pipeline.shards.plan import ShardPlan
from pipeline.shards.samples import read_samples
from pipeline.shards.shard_set import open_shards
from pipeline.shards.writer import write_shard
from pipeline.sources.university1652 import University1652

CLASSES = ("0003", "0008", "0839", "Aa")
SATELLITES, DRONES = 21, 40
PLAIN = StreamConfig(
    batch_size=4,
    image_size=8,
    augmentation=Augmentation(pad=0, rotation=0, mirror=False),
    threads=1,
)


def records(folder: Path, view: View, images: int) -> list[ImageRecord]:
    """Images of one colour each, spread over the classes."""
    found = []
    for number in range(images):
        path = folder / f"{view}-{number:03d}.png"
        Image.new("RGB", (9, 8), (number, 2 * number, list(View).index(view))).save(path)
        location = CLASSES[number % len(CLASSES)]
        found.append(ImageRecord(path=str(path), split=Split.TRAIN, view=view, location=location))
    return found


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> str:
    """21 satellite images in shards of 8, 8 and 5, and 40 UAV images in shards of 15, 15 and 10."""
    root = tmp_path_factory.mktemp("world")
    out, written = str(root / "shards"), []
    for view, images, size in ((View.SATELLITE, SATELLITES, 8), (View.DRONE, DRONES, 15)):
        every = records(root, view, images)
        for number, start in enumerate(range(0, images, size)):
            plan = ShardPlan(
                name=f"train-{view}-{number:06d}",
                split=Split.TRAIN,
                view=view,
                records=tuple(every[start : start + size]),
            )
            written.append(write_shard(plan, University1652(), out, "").shard)
    manifest = Manifest(shards=tuple(written), classes=CLASSES, packing={}, rejected=0)
    json_files.write_checksummed(storage.join(out, MANIFEST), asdict(manifest))
    return out


def keys(batches: list[tuple[Batch, Batch]], view: View) -> list[str]:
    return [key for pair in batches for batch in pair if batch.view == view for key in batch.keys]


def epoch(
    shards: str, number: int = 0, rank: int = 0, world: int = 1, reading: StreamConfig = PLAIN
) -> list[tuple[Batch, Batch]]:
    return list(TrainingStream(open_shards(shards), reading, rank, world).epoch(number))


# The planner.

SIZES = st.lists(st.integers(0, 9), min_size=1, max_size=6)


def shard_list(sizes: list[int]) -> list[Shard]:
    return [
        Shard(
            name=f"s{number}",
            split=Split.TRAIN,
            view=View.DRONE,
            samples=samples,
            bytes=0,
            sha256="",
        )
        for number, samples in enumerate(sizes)
    ]


def planned(
    sizes: list[int], wanted: int, rank: int, world: int, seed: int
) -> list[tuple[str, int]]:
    """Shard and position of each sample that a rank reads."""
    spans = plan_pass(shard_list(sizes), wanted, rank, world, np.random.default_rng(seed))
    return [
        (span.shard.name, position) for span in spans for position in range(span.start, span.stop)
    ]


@settings(max_examples=200)
@given(sizes=SIZES, wanted=st.integers(0, 30), world=st.integers(1, 5), seed=st.integers(0, 99))
def test_each_rank_reads_as_many_samples_as_wanted_and_no_sample_comes_twice_before_all_came_once(
    sizes: list[int], wanted: int, world: int, seed: int
) -> None:
    ranks = [planned(sizes, wanted, rank, world, seed) for rank in range(world)]
    total = sum(sizes)
    assert [len(rank) for rank in ranks] == [wanted if total else 0] * world
    seen = Counter(sample for rank in ranks for sample in rank)
    assert all(0 <= position < sizes[int(name[1:])] for name, position in seen)
    if total:
        rounds, rest = divmod(
            world * wanted, total
        )  # the ring gone round again where it is too short
        assert set(seen.values()) <= {rounds, rounds + 1}
        assert sum(times == rounds + 1 for times in seen.values()) == rest
        assert len(seen) == (total if rounds else rest)


@settings(max_examples=50)
@given(sizes=SIZES, wanted=st.integers(0, 30), world=st.integers(1, 5), seed=st.integers(0, 99))
def test_a_plan_is_decided_by_its_random_numbers_alone(
    sizes: list[int], wanted: int, world: int, seed: int
) -> None:
    assert planned(sizes, wanted, world - 1, world, seed) == planned(
        sizes, wanted, world - 1, world, seed
    )


def test_every_sample_is_left_out_of_some_pass() -> None:
    left_out = {("s0", n) for n in range(5)} | {("s1", n) for n in range(4)}
    for seed in range(60):
        left_out &= set(planned([5, 4], 8, 0, 1, seed))
    assert not left_out


def test_shards_without_samples_give_an_empty_plan() -> None:
    assert planned([], 5, 0, 1, 0) == planned([0, 0], 5, 0, 1, 0) == []


# Reading and its order.


@pytest.mark.parametrize("buffer", [1, 7, 100])
def test_shuffle_keeps_every_sample_and_repeats(shards: str, buffer: int) -> None:
    stream = TrainingStream(open_shards(shards), replace(PLAIN, shuffle_buffer=buffer))
    once, again = (
        [sample.key for _, sample in stream.sample_pipeline(View.SATELLITE, 3)] for _ in range(2)
    )
    spans = stream.plan(View.SATELLITE, 3)
    planned_keys = [sample.key for sample in read_spans(stream.shards, frozenset(), spans)]
    assert once == again
    assert sorted(once) == sorted(planned_keys)
    assert (once == planned_keys) == (buffer == 1)


def test_work_ahead_keeps_its_order_and_stays_within_its_depth() -> None:
    drawn = count()
    numbers: Iterator[int] = (next(drawn) for _ in range(100))
    results = prefetch_map(lambda number: number * number, numbers, threads=3, depth=5)
    assert [next(results) for _ in range(4)] == [0, 1, 4, 9]
    assert next(drawn) <= 4 + 5
    results.close()  # type: ignore[attr-defined]


def test_work_ahead_runs_beside_the_consumer_and_hands_on_an_error_at_its_place() -> None:
    started = Event()

    def work(number: int) -> int:
        if number == 1:
            started.set()
        if number == 2:
            raise DecodeError("damaged image", "here")
        return number

    results = prefetch_map(work, range(4), threads=1, depth=2)
    assert next(results) == 0
    assert started.wait(10)
    assert next(results) == 1
    with pytest.raises(DecodeError, match="here"):
        next(results)


def test_items_are_ready_before_they_are_asked_for_and_no_more_than_so_many() -> None:
    made, third = count(), Event()

    def source() -> Iterator[int]:
        while (number := next(made)) < 10:
            if number == 3:
                third.set()
            if number == 6:
                raise DecodeError("damaged image", "here")
            yield number

    items = prefetch(source(), depth=3)
    assert next(items) == 0
    assert third.wait(10)  # while nobody asks
    assert next(made) == 4
    assert [next(items) for _ in range(4)] == [1, 2, 3, 5]
    with pytest.raises(DecodeError, match="here"):
        next(items)
    assert list(prefetch(range(5), depth=9)) == list(range(5))


def test_a_shard_reads_back_as_it_was_packed(shards: str) -> None:
    samples = list(read_samples(f"{shards}/train-satellite-000002.tar"))
    assert [held.key for held in samples] == [held.metadata["key"] for held in samples]
    assert [held.metadata["location"] for held in samples] == [
        CLASSES[number % 4] for number in range(16, 21)
    ]
    assert all(held.data.startswith(b"\x89PNG") for held in samples)
    opened = open_shards(shards)
    shard = next(one for one in opened.manifest.shards if one.name == "train-satellite-000002")
    part = list(read_spans(opened, frozenset(), [Span(shard=shard, start=1, stop=3)]))
    assert [held.key for held in part] == [held.key for held in samples[1:3]]


# The training stream.


def test_an_epoch_sees_each_satellite_image_at_most_once_and_all_but_the_last_partial_batch(
    shards: str,
) -> None:
    batches = epoch(shards)
    assert TrainingStream(open_shards(shards), PLAIN).steps == len(batches) == SATELLITES // 4
    seen = keys(batches, View.SATELLITE)
    assert len(seen) == len(set(seen)) == 20


def test_the_uav_view_gives_as_many_images_and_others_each_epoch(shards: str) -> None:
    first, second = (keys(epoch(shards, number), View.DRONE) for number in (0, 1))
    assert len(first) == len(set(first)) == len(second) == 20
    assert set(first) != set(second)


def test_pairs_are_a_uav_batch_and_a_satellite_batch_drawn_independently(shards: str) -> None:
    batches = epoch(shards)
    assert {(drone.view, satellite.view) for drone, satellite in batches} == {
        (View.DRONE, View.SATELLITE)
    }
    assert any(
        drone.location_B.tolist() != satellite.location_B.tolist() for drone, satellite in batches
    )


def test_the_satellite_image_that_is_dropped_differs_between_epochs(shards: str) -> None:
    seen = [frozenset(keys(epoch(shards, number), View.SATELLITE)) for number in range(6)]
    assert len(set(seen)) > 2
    assert len(frozenset.union(*seen)) == SATELLITES


@pytest.mark.parametrize("world", [2, 3])
def test_ranks_see_no_image_twice_among_them_and_take_equal_steps(shards: str, world: int) -> None:
    ranks = [epoch(shards, 4, rank, world, replace(PLAIN, batch_size=3)) for rank in range(world)]
    assert {len(batches) for batches in ranks} == {SATELLITES // (3 * world)}
    for view in (View.DRONE, View.SATELLITE):
        seen = [key for batches in ranks for key in keys(batches, view)]
        assert len(seen) == len(set(seen)) == 3 * world * (SATELLITES // (3 * world))


def test_the_same_seed_and_epoch_give_the_same_batches_whatever_the_threads(shards: str) -> None:
    lively = replace(PLAIN, augmentation=Augmentation(pad=2))
    once, again = (epoch(shards, 3, reading=replace(lively, threads=threads)) for threads in (1, 3))
    for pair, same in zip(once, again, strict=True):
        for batch, other in zip(pair, same, strict=True):
            assert batch.keys == other.keys
            assert np.array_equal(batch.images_B3HW, other.images_B3HW)


def test_other_epochs_and_other_seeds_give_another_order(shards: str) -> None:
    orders = {
        tuple(keys(epoch(shards, number, reading=replace(PLAIN, seed=seed)), View.SATELLITE))
        for number in (0, 1, 2)
        for seed in (0, 1)
    }
    assert len(orders) == 6


def test_each_epoch_and_each_rank_augments_in_its_own_way(shards: str) -> None:
    turning = replace(PLAIN, augmentation=Augmentation(pad=0, mirror=False), batch_size=3)
    corners = []
    for number, rank in ((0, 0), (1, 0), (0, 1)):
        batches = epoch(shards, number, rank, 2, turning)
        corners.append([(satellite.images_B3HW.sum(1) == 0).tobytes() for _, satellite in batches])
    assert corners[0] != corners[1]
    assert corners[0] != corners[2]


def test_an_epoch_can_be_seen_without_those_before_it(shards: str) -> None:
    stream = TrainingStream(open_shards(shards), PLAIN)
    for number in (0, 1):
        last = list(stream.epoch(number))
    assert [pair[1].keys for pair in last] == [pair[1].keys for pair in epoch(shards, 1)]


@pytest.mark.parametrize("skip", [0, 1, 4, 5])
def test_an_epoch_can_be_entered_at_any_step_and_goes_on_as_it_would_have(
    shards: str, skip: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    lively = replace(PLAIN, augmentation=Augmentation(pad=2), shuffle_buffer=7)
    whole = epoch(shards, 2, reading=lively)
    opened = count()
    monkeypatch.setattr(
        "pipeline.batches.training.decode", lambda data: (next(opened), decode(data))[1]
    )
    rest = list(TrainingStream(open_shards(shards), lively).epoch(2, skip))
    assert len(rest) == len(whole) - skip
    assert next(opened) == 2 * 4 * len(rest)  # what is skipped is not decoded
    for pair, same in zip(whole[skip:], rest, strict=True):
        for batch, other in zip(pair, same, strict=True):
            assert batch.keys == other.keys
            assert np.array_equal(batch.images_B3HW, other.images_B3HW)


def test_labels_are_the_manifests_class_numbers_and_images_those_of_their_keys(shards: str) -> None:
    for pair in epoch(shards):
        for batch in pair:
            assert batch.images_B3HW.shape == (4, 3, 8, 8)
            assert batch.images_B3HW.dtype == np.uint8
            assert batch.location_B.dtype == np.int64
            for key, label, image_3HW in zip(
                batch.keys, batch.location_B, batch.images_B3HW, strict=True
            ):
                number = int(key.split("-")[4])
                assert label == number % len(CLASSES)
                colour = (number, 2 * number, list(View).index(batch.view))
                assert (image_3HW == np.array(colour)[:, None, None]).all()


def test_images_lie_channels_last_in_memory_as_the_network_wants_them(shards: str) -> None:
    images_B3HW = epoch(shards)[0][0].images_B3HW
    assert images_B3HW.transpose(0, 2, 3, 1).flags.c_contiguous


@pytest.mark.parametrize(("batch_size", "world"), [(22, 1), (11, 2)])
def test_a_set_too_small_for_one_step_is_refused_with_the_remedy(
    shards: str, batch_size: int, world: int
) -> None:
    with pytest.raises(
        InputError, match=r"21 satellite and 40 UAV .* one batch of 22 .*smaller batch"
    ):
        TrainingStream(open_shards(shards), replace(PLAIN, batch_size=batch_size), 0, world)


def test_fewer_uav_than_satellite_images_come_again_within_an_epoch(
    shards: str, tmp_path: Path
) -> None:
    said = json_files.read_checksummed(storage.join(shards, MANIFEST))
    said["shards"] = [
        shard for shard in said["shards"] if shard["view"] == "satellite" or shard["samples"] == 10
    ]
    for tar in Path(shards).glob("*.tar"):
        (tmp_path / tar.name).symlink_to(tar)
    json_files.write_checksummed(str(tmp_path / MANIFEST), said)
    seen = Counter(keys(epoch(str(tmp_path)), View.DRONE))
    assert set(seen.values()) == {2}
    assert len(seen) == 10


# Images that were damaged after packing.


def with_damage(shards: str, out: Path, spoilt: Callable[[str], bool]) -> str:
    """The same set; the images whose member's name says so have lost their pixels."""
    for path in filter(Path.is_file, Path(shards).iterdir()):
        if path.suffix != ".tar":
            (out / path.name).write_bytes(path.read_bytes())
            continue
        with tarfile.open(path) as old, tarfile.open(out / path.name, "w") as new:
            for member in old.getmembers():
                stream = old.extractfile(member)
                assert stream is not None
                data = stream.read()
                if member.name.endswith(".png") and spoilt(member.name):
                    data = data[:40] + bytes(len(data) - 40)
                new.addfile(member, io.BytesIO(data))
    return str(out)


def odd(name: str) -> bool:
    """Whether an image's number, in its key or its member's name, ends in 1 or 3."""
    return name.split("-")[4][2] in "13"


def test_a_damaged_images_place_is_taken_by_the_first_whole_one_of_its_batch_under_its_own_label(
    shards: str, tmp_path: Path
) -> None:
    broken = with_damage(shards, tmp_path, odd)
    lively = replace(PLAIN, augmentation=Augmentation(pad=2))
    counted = 0
    for pair, same in zip(
        epoch(shards, 2, reading=lively), epoch(broken, 2, reading=lively), strict=True
    ):
        for batch, found in zip(pair, same, strict=True):
            whole = [place for place, key in enumerate(batch.keys) if not odd(key)]
            taken = [place if place in whole else whole[0] for place in range(4)]
            assert found.keys == tuple(batch.keys[place] for place in taken)
            assert found.damaged == tuple(key for key in batch.keys if odd(key))
            assert found.location_B.tolist() == [batch.location_B[place] for place in taken]
            assert np.array_equal(found.images_B3HW, batch.images_B3HW[taken])
            assert batch.damaged == ()
            counted += len(found.damaged)
    assert counted > 4


def test_damaged_images_leave_an_epoch_that_is_entered_later_as_it_would_have_been(
    shards: str, tmp_path: Path
) -> None:
    stream = TrainingStream(open_shards(with_damage(shards, tmp_path, odd)), PLAIN)
    for pair, same in zip(list(stream.epoch(1))[3:], stream.epoch(1, 3), strict=True):
        for batch, other in zip(pair, same, strict=True):
            assert (batch.keys, batch.damaged) == (other.keys, other.damaged)
            assert np.array_equal(batch.images_B3HW, other.images_B3HW)


def test_a_batch_without_a_whole_image_stops_training_with_the_sets_name(
    shards: str, tmp_path: Path
) -> None:
    broken = with_damage(shards, tmp_path, lambda name: "satellite" in name)
    with pytest.raises(
        InputError,
        match=rf"not one of 4 satellite images of a batch from {tmp_path} can be decoded",
    ):
        epoch(broken)


# Reading for embedding and for pictures.


def test_images_for_embedding_come_in_the_shards_order_and_an_undecodable_one_as_its_error(
    shards: str, tmp_path: Path
) -> None:
    with (
        tarfile.open(Path(shards) / "train-drone-000002.tar") as old,
        tarfile.open(tmp_path / "x.tar", "w") as new,
    ):
        for number, member in enumerate(old.getmembers()):
            stream = old.extractfile(member)
            if number == 2:  # the second sample's image, cut short
                member.size -= 30
            new.addfile(member, stream)
    found = list(decode_samples(read_samples(str(tmp_path / "x.tar")), 8, threads=2, depth=4))
    assert [held.key for held, _ in found] == [
        held.key for held in read_samples(f"{shards}/train-drone-000002.tar")
    ]
    kinds = [type(image) for _, image in found]
    assert kinds == [np.ndarray, DecodeError, *[np.ndarray] * 8]
    assert all(image.shape == (8, 8, 3) for _, image in found if not isinstance(image, DecodeError))


def test_pictures_are_fetched_by_key_as_the_sources_bytes_and_unknown_keys_are_absent(
    shards: str,
) -> None:
    wanted = [
        "train-satellite-0003-satellite-004",
        "train-drone-0839-drone-038",
        "train-drone-0839-no",
        "query-x",
    ]
    found = open_shards(shards).fetch(wanted)
    assert set(found) == set(wanted[:2])
    assert found[wanted[1]] == (Path(shards).parent / "drone-038.png").read_bytes()
    assert open_shards(shards).fetch([]) == {}


def test_plain_tarfile_opens_a_shard_and_finds_two_members_a_sample(shards: str) -> None:
    with tarfile.open(Path(shards) / "train-satellite-000000.tar") as tar:
        names = tar.getnames()
        assert {(m.mtime, m.uname, m.mode) for m in tar.getmembers()} == {(0, "root", 0o644)}
    assert len(names) == 16
    assert {name.rsplit(".", 1)[1] for name in names} == {"png", "json"}


@pytest.mark.filterwarnings(
    "ignore:unclosed file:ResourceWarning"
)  # webdataset's own reader leaves it to the collector
def test_plain_webdataset_opens_a_shard(shards: str) -> None:
    dataset = webdataset.WebDataset(
        str(Path(shards) / "train-satellite-000000.tar"), shardshuffle=False
    )
    found = list(dataset.decode("pil"))
    assert len(found) == 8
    for held in found:
        assert held["png"].size == (9, 8)
        assert held["json"]["key"] == held["__key__"]
        assert json.dumps(held["json"])
        assert held["json"]["view"] == "satellite"
