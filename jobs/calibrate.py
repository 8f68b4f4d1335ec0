"""How sure an index's answers are: `calibrate.py --checkpoint FILE --shards DIR --index INDEX`.

Photos of places that the network was not trained on are asked of the index, once with their place
in the gallery and once without. Writes INDEX/calibration.json, which locate.py and serve.py take
from there, and the reliability diagram beside it.
"""

from dataclasses import dataclass
from itertools import islice

import numpy as np

from jobs.command_line.cli import run
from jobs.encoding.encoder import read_checkpoint_bytes
from jobs.encoding.photo_encoder import PhotoEncoder
from model.checkpoint import loads
from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.progress import console, progress, results
from pipeline.core.records import Split, View
from pipeline.index.searcher import Index
from pipeline.locate.calibrate import CalibrationContext, CalibrationCriteria, fit_calibration
from pipeline.locate.calibration import (
    CALIBRATION_FILE,
    Calibration,
    read_calibration,
    write_calibration,
)
from pipeline.locate.calibration_data import LabelledImages, make_examples
from pipeline.locate.gallery_map import read_gallery_map
from pipeline.locate.reliability import reliability_diagram
from pipeline.shards.external import open_manifest
from pipeline.shards.manifest import require_tars
from pipeline.shards.samples import read_shard

ENCODE_BATCH = 256
"Photos that are encoded and asked at a time."


@dataclass(frozen=True, kw_only=True)
class Settings(CalibrationCriteria):
    """What is calibrated, on which photos."""

    checkpoint: str
    "The network that the index was made with."
    shards: str
    """Folder or URI of shards with photos of places that the network was not trained on, and the
    gallery's view of them."""
    index: str
    "Folder or URI of the index."
    out: str | None = None
    "The calibration; by default INDEX/calibration.json."
    split: Split = Split.TRAIN
    """Which split's photos; of the training split, those of places held out (train.py --hold-out).
    Never the test set's."""
    view: View = View.DRONE
    "Of the photos."
    gallery_view: View = View.SATELLITE
    "Of the gallery's images."
    photos: int = 2000
    "At most so many photos."

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.photos < 1:
            raise InputError(f"--photos is {self.photos}, expected at least 1")


def calibrate_index(settings: Settings) -> Calibration:
    """Calibrate an index, unless its calibration is there; one of another gallery or settings is
    replaced. Returns it.

    Raises InputError and CheckpointError on unusable input.
    """
    out = settings.out or storage.join(settings.index, CALIBRATION_FILE)
    index = Index(settings.index)
    asked = f"{settings.split} {settings.view} -> {settings.gallery_view}, at most {settings.photos} photos"
    wanted = (asked, len(index), settings.tolerance, settings.outside)
    there = load_if_done(out, index)
    if there and (there.asked, there.gallery, there.tolerance_m, there.outside) == wanted:
        console.print(f"{out} is complete; nothing to do")
        return there
    data = read_checkpoint_bytes(settings.checkpoint)
    encoder = PhotoEncoder(data, settings.checkpoint, index.facts, settings.shards)
    trained_on = frozenset(loads(data, settings.checkpoint).locations)
    photos = embed_view(settings, encoder, settings.view, trained_on, settings.photos)
    overhead = embed_view(settings, encoder, settings.gallery_view, trained_on, None)
    spacing_m = read_gallery_map(index).spacing_m
    found = make_examples(photos, overhead, index, spacing_m, settings.tolerance)
    gallery = CalibrationContext(
        fingerprint=encoder.fingerprint, rows=len(index), spacing_m=spacing_m, asked=asked
    )
    confidence = fit_calibration(found, settings, gallery)
    write_calibration(out, confidence)
    picture = f"{out.removesuffix('.json')}.svg"
    storage.write_bytes(
        picture,
        reliability_diagram(
            confidence.bins, f"Reliability over {confidence.photos} photos"
        ).encode(),
    )
    console.print(summary(confidence))
    results.print(f"calibration: {out}, diagram: {picture}", soft_wrap=True)
    return confidence


def load_if_done(out: str, index: Index) -> Calibration | None:
    """The calibration that is there; none where it is another network's or damaged, as it is to be
    replaced.
    """
    try:
        return read_calibration(out, index.facts) if storage.exists(out) else None
    except InputError:
        return None


def embed_view(
    settings: Settings,
    encoder: PhotoEncoder,
    view: View,
    trained_on: frozenset[str],
    most: int | None,
) -> LabelledImages:
    """The first images of a view that show places which were not trained on, with their embeddings;
    damaged ones left out.

    Shards are in the order of hashes, so the first ones are a fair sample.
    """
    shards = open_manifest(settings.shards, settings.split, view).of(settings.split, view)
    require_tars(settings.shards, shards)
    samples = (
        sample
        for shard in shards
        for sample in read_shard(settings.shards, shard.name, shard.split, shard.view)
        if sample.facts["location"] not in trained_on
    )
    facts, blocks = [], [np.empty((0, encoder.dimension), np.float32)]
    with progress(None, f"{view} images", "images") as meter:
        wanted = islice(samples, most)
        while batch := list(islice(wanted, ENCODE_BATCH)):
            block_BD, rejected = encoder.encode([sample.data for sample in batch])
            facts += [
                sample.facts
                for sample, refused in zip(batch, rejected, strict=True)
                if refused is None
            ]
            blocks.append(block_BD)
            meter.advance(len(batch))
    return LabelledImages(facts=facts, embeddings_QD=np.concatenate(blocks))


def summary(confidence: Calibration) -> str:
    """What the calibration found, in words."""
    return (
        f"{confidence.photos} photos of {confidence.locations} places not trained on: {confidence.right:.1%} answered rightly; "
        f"expected calibration error {confidence.calibration_error:.3f}; below a probability of {confidence.threshold:.2f} an "
        f"answer is unknown, which keeps {confidence.right_kept:.1%} of the right answers and says unknown to "
        f"{confidence.outside_unknown:.1%} of the photos without their place"
    )


def main(settings: Settings) -> None:
    """Calibrate how sure an index's answers are, on photos of places that the network was not
    trained on.
    """
    calibrate_index(settings)


if __name__ == "__main__":
    run(main)
