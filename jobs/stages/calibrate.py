"""Calibrate the probabilities of an index's answers: `calibrate.py --checkpoint FILE --shards DIR
--index INDEX`

Searches the index for photos of locations that the encoder was not trained on, once with their
location in the gallery and once without. With --flight, for photos over the map whose places are
known, which are then matched with the map as locate.py matches them. Writes INDEX/calibration.json,
which locate.py and serve.py read from there, and the reliability diagram beside it.
"""

from dataclasses import replace
from itertools import islice

import numpy as np

from jobs.encoding.encoder import read_checkpoint_bytes
from jobs.encoding.photo_encoder import PhotoEncoder
from jobs.stages.calibrate_flight import flight_of, match_flight, search_flight, selection_of
from jobs.stages.matching import open_map
from jobs.stages.settings import CalibrateSettings
from model.checkpoint import loads
from pipeline.confidence.reliability import reliability_diagram
from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.progress import console, progress, results
from pipeline.core.records import View
from pipeline.index.searcher import Index
from pipeline.locate.calibration import (
    CALIBRATION_FILE,
    Calibration,
    read_calibration,
    write_calibration,
)
from pipeline.locate.fitting.calibrate import CalibrationContext, fit_calibration
from pipeline.locate.fitting.calibration_data import LabelledImages, make_examples
from pipeline.locate.fitting.fit_matching import fit_matching
from pipeline.locate.gallery_map import GalleryMap, read_gallery_map
from pipeline.locate.settings import CalibrationCriteria
from pipeline.shards.shard_set import open_or_scan

ENCODE_BATCH = 256
"Images that are encoded at a time."


def calibrate_index(settings: CalibrateSettings) -> Calibration:
    """Calibrate an index and return the calibration; does nothing where a finished one exists, and
    replaces one of another gallery or other settings.

    Raises InputError and CheckpointError on unusable input.
    """
    out = settings.out or storage.join(settings.index, CALIBRATION_FILE)
    index = Index(settings.index)
    views = f"{settings.split} {settings.view} -> {settings.gallery_view}"
    selection = f"{views}, at most {settings.photos} photos"
    if settings.flight:
        selection = selection_of(settings.flight, settings.photos)
        if settings.surface:
            selection += ", heights known"
    if done := load_if_done(out, index, selection, settings):
        console.print(f"{out} is complete; nothing to do")
        return done
    data = read_checkpoint_bytes(settings.checkpoint)
    encoder = PhotoEncoder(
        data, settings.checkpoint, index.metadata.fingerprint, index.metadata.encoding
    )
    gallery = read_gallery_map(index)
    context = CalibrationContext(
        fingerprint=encoder.fingerprint,
        gallery_rows=len(index),
        spacing_m=gallery.spacing_m,
        finest_side_m=gallery.finest_side_m,
        photo_selection=selection,
    )
    if settings.flight:
        calibration = _calibrate_on_flight(
            settings, settings.flight, encoder, index, gallery, context
        )
    else:
        trained_on = frozenset(loads(data, settings.checkpoint).locations)
        photos = embed_view(settings, encoder, settings.view, trained_on, settings.photos)
        overhead = embed_view(settings, encoder, settings.gallery_view, trained_on, None)
        examples = make_examples(
            photos, overhead, index, gallery.spacing_m, settings.tolerance, gallery.finest_side_m
        )
        calibration = fit_calibration(examples, settings, context)
    write_calibration(out, calibration)
    picture = f"{out.removesuffix('.json')}.svg"
    diagram = calibration.matching or calibration
    title = f"Reliability over {diagram.photos} photos"
    storage.write_bytes(picture, reliability_diagram(diagram.bins, title).encode())
    console.print(matching_summary(calibration) if calibration.matching else summary(calibration))
    results.print(f"calibration: {out}, diagram: {picture}", soft_wrap=True)
    return calibration


def _calibrate_on_flight(
    settings: CalibrateSettings,
    flight: str,
    encoder: PhotoEncoder,
    index: Index,
    gallery: GalleryMap,
    context: CalibrationContext,
) -> Calibration:
    windows = open_map(settings.shards, gallery, settings.index, settings.surface)
    if windows is None:
        raise InputError(
            f"the tiles of {settings.shards} do not know their corners, expected such as a "
            "GeoTIFF's, to match photos with; pack the map with jobs/make_shards.py, or leave out "
            "--flight"
        )
    photos = flight_of(flight, settings.photos)
    searched = search_flight(photos, encoder, index, gallery, windows)
    calibration = fit_calibration([one.example for one in searched], settings, context)
    matched = match_flight(searched, windows, calibration)
    return replace(calibration, matching=fit_matching(matched, calibration, settings.within))


def load_if_done(
    out: str, index: Index, selection: str, criteria: CalibrationCriteria
) -> Calibration | None:
    """The calibration at `out` if it is of this index, selection of photos and criteria; else None,
    also where it is damaged or of another encoder, as it is then replaced."""
    try:
        found = read_calibration(out, index.metadata.fingerprint) if storage.exists(out) else None
    except InputError:
        return None
    if found is None:
        return None
    wanted = (selection, len(index), criteria.tolerance, criteria.outside)
    same = (found.photo_selection, found.gallery_rows, found.tolerance_m, found.outside) == wanted
    if found.matching and found.matching.gate.within_m != criteria.within:
        return None
    return found if same else None


def embed_view(
    settings: CalibrateSettings,
    encoder: PhotoEncoder,
    view: View,
    trained_on: frozenset[str],
    limit: int | None,
) -> LabelledImages:
    """The first `limit` images of a view whose locations were not trained on, with their
    embeddings; damaged ones are left out.

    Shards are in the order of hashes, so the first ones are a fair sample.
    """
    shards = open_or_scan(settings.shards, settings.split, view)
    wanted = shards.manifest.of(settings.split, view)
    shards.require_tars(wanted)
    samples = (
        sample
        for shard in wanted
        for sample in shards.samples(shard)
        if sample.metadata["location"] not in trained_on
    )
    records, blocks = [], [np.empty((0, encoder.dimension), np.float32)]
    with progress(None, f"{view} images", "images") as meter:
        chosen = islice(samples, limit)
        while batch := list(islice(chosen, ENCODE_BATCH)):
            drones = view == View.DRONE
            block_BD, rejections = encoder.encode(
                [sample.data for sample in batch],
                geotags=[sample.metadata["geotag"] if drones else None for sample in batch],
            )
            pairs = zip(batch, rejections, strict=True)
            records += [sample.metadata for sample, rejection in pairs if rejection is None]
            blocks.append(block_BD)
            meter.advance(len(batch))
    return LabelledImages(records=records, embeddings_QD=np.concatenate(blocks))


def summary(calibration: Calibration) -> str:
    """The calibration's figures in one sentence."""
    return (
        f"{calibration.photos} photos of {calibration.locations} locations not trained on: "
        f"{calibration.accuracy:.1%} answered rightly; expected calibration error "
        f"{calibration.calibration_error:.3f}; below a probability of {calibration.threshold:.2f} "
        f"an answer is unknown, which keeps {calibration.right_kept:.1%} of the right answers and "
        f"answers unknown for {calibration.outside_unknown:.1%} of the photos without their "
        "location"
    )


def matching_summary(calibration: Calibration) -> str:
    """The figures of a calibration with matching in one sentence."""
    matching = calibration.matching
    assert matching is not None
    return (
        f"{matching.photos} framed photos: {matching.refined:.1%} refined within "
        f"{matching.gate.within_m:g} m; {matching.known:.1%} answered, of which "
        f"{matching.known_right:.1%} rightly (a tile's answer within {calibration.tolerance_m:g} "
        f"m); expected calibration error {matching.calibration_error:.3f}; unknown for "
        f"{matching.outside_unknown:.1%} of the photos without their place in the gallery; "
        f"beside the matches' own error, 95 % lie within {matching.gate.floor_m:.2f} m"
    )
