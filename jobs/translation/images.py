"""The images of a set of shards, those of the UAV translated, in University-1652's layout.

In: shards and a trained generator. Out: a folder that jobs/make_shards.py packs; finished files are
kept, since the same generator makes the same ones.
"""

import csv
import io
from collections.abc import Iterator
from itertools import islice

import simplejpeg
import torch

from model.translation import TranslationTraining
from pipeline.batches.ordered import decode_samples, is_damaged, split_failed, stack
from pipeline.core import storage
from pipeline.core.arrays import Pixels
from pipeline.core.progress import progress
from pipeline.core.records import Split, View, make_key
from pipeline.shards.samples import Sample
from pipeline.shards.shard_set import ShardSet

FOLDERS = {Split.TRAIN: "train/", Split.QUERY: "test/query_", Split.GALLERY: "test/gallery_"}
SUFFIXES = {b"\xff\xd8": "jpg", b"\x89P": "png", b"RI": "webp", b"II": "tif", b"MM": "tif"}
"By the first two bytes of an image."
QUALITY = 95
"Of the translated images' JPEG [chosen]."
THREADS = 2


def write_images(
    shards: ShardSet, training: TranslationTraining, out: str, batch_size: int
) -> None:
    """Write every UAV image translated and every satellite image as it is, and `locations.csv`;
    an image that cannot be decoded is left out.
    """
    positions: dict[str, tuple[float, float]] = {}
    chosen = [one for one in shards.manifest.shards if one.view in (View.DRONE, View.SATELLITE)]
    with progress(sum(one.samples for one in chosen), "translate", "images") as meter:
        for shard in chosen:
            missing = _missing(shards.samples(shard), out, positions)
            if shard.view == View.SATELLITE:
                for sample in missing:
                    storage.write_bytes(path_of(sample, out), sample.data)
            else:
                for sample, image_HW3 in _translated(missing, training, batch_size):
                    data = simplejpeg.encode_jpeg(image_HW3, QUALITY, colorsubsampling="444")
                    storage.write_bytes(path_of(sample, out), data)
            meter.advance(shard.samples)
    if positions:
        text = io.StringIO()
        rows = [(name, lat, lon) for name, (lat, lon) in sorted(positions.items())]
        csv.writer(text).writerows([("location", "lat", "lon"), *rows])
        storage.write_bytes(storage.join(out, "locations.csv"), text.getvalue().encode())


def path_of(sample: Sample, out: str) -> str:
    """Where a sample's image goes: its key in the new shards is the old one, where the old one was
    made of a file's name."""
    split, view = Split(sample.metadata["split"]), View(sample.metadata["view"])
    location = sample.metadata["location"].replace("/", "_")
    stem = sample.key.removeprefix(make_key(split, view, location, ""))
    suffix = "jpg" if view == View.DRONE else SUFFIXES.get(sample.data[:2], "jpg")
    return storage.join(out, f"{FOLDERS[split]}{view}/{location}/{stem}.{suffix}")


def _missing(
    samples: Iterator[Sample], out: str, positions: dict[str, tuple[float, float]]
) -> Iterator[Sample]:
    """The samples whose files are not there; notes the positions of all locations."""
    for sample in samples:
        if tag := sample.metadata["geotag"]:
            name = sample.metadata["location"].replace("/", "_")
            positions.setdefault(name, (tag["lat"], tag["lon"]))
        if not storage.exists(path_of(sample, out)):
            yield sample


def _translated(
    samples: Iterator[Sample], training: TranslationTraining, batch_size: int
) -> Iterator[tuple[Sample, Pixels]]:
    images = decode_samples(
        samples, training.config.side, THREADS, 2 * batch_size, perspective="overhead"
    )
    intact = (one for one in images if not is_damaged(one))
    while group := list(islice(intact, batch_size)):
        decoded, _ = split_failed(group)
        made = training.translate(torch.from_numpy(stack([image for _, image in decoded])))
        rows = made.permute(0, 2, 3, 1).contiguous().numpy()
        yield from zip((sample for sample, _ in decoded), rows, strict=True)
