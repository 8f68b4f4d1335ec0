"""Where were these photos taken? `locate.py --checkpoint FILE --index INDEX --out FILE.geojson
PHOTO...`

Photos, or folders of them, are embedded as the index's images were, and the index is asked. Writes
GeoJSON, on demand CSV and a page with a map. Photos that cannot be decoded are listed with the
reason, the others are answered, and the exit code is 1.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import numpy as np
import tyro
from rich import box
from rich.table import Table

from jobs.command_line.cli import run
from jobs.encoding.encoder import read_checkpoint_bytes
from jobs.encoding.photo_encoder import PhotoEncoder
from jobs.encoding.queries import Query, encode_photos, merge_by_folder
from pipeline.core import rejections, storage
from pipeline.core.errors import Incomplete, InputError
from pipeline.core.geo import Circle
from pipeline.core.progress import console, results
from pipeline.features.part import verify_part
from pipeline.images.thumbnails import no_images
from pipeline.index.filters import Filter
from pipeline.index.searcher import Index
from pipeline.locate import geojson
from pipeline.locate.calibration import Calibration, find_calibration, read_calibration
from pipeline.locate.flight import TRACK_THRESHOLD, apply_track, motion_for_gallery
from pipeline.locate.gallery_map import GalleryMap, read_gallery_map
from pipeline.locate.geojson import LocatedPhoto
from pipeline.locate.locate import Answer, locate_embeddings
from pipeline.locate.page import LatLon, PageContext, render_page
from pipeline.locate.photo_files import find_photos, parse_time, read_times
from pipeline.locate.track import TRACK_CANDIDATES, Motion, TrackStart
from pipeline.shards.manifest import read_manifest
from pipeline.shards.record_table import footprints
from pipeline.shards.samples import fetch

CIRCLE_FLAG: Any = tyro.constructors.PrimitiveConstructorSpec(
    nargs=3,  # tyro's own reading of an optional tuple takes the photos behind it as well
    metavar="LAT LON METRES",
    instance_from_str=lambda said: Circle(
        lat=float(said[0]), lon=float(said[1]), radius_m=float(said[2])
    ),
    is_instance=lambda value: value is None or isinstance(value, Circle),
    str_from_instance=lambda value: (
        [str(value)] if value is None else [str(value.lat), str(value.lon), str(value.radius_m)]
    ),
)
"How a circle is told on the command line."


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Which photos are looked for in which index, and what is written."""

    photos: tyro.conf.Positional[tuple[str, ...]]
    "Photos, or folders with photos below them; paths or URIs."
    checkpoint: str
    "The network that the index was made with."
    index: str
    "Folder or URI of the index."
    out: str
    "The GeoJSON file with a point per photo."
    top: int = 5
    "Candidates that are listed of each photo."
    together: bool = False
    "All photos of a folder show one place: they are asked as one, by the mean of their embeddings."
    near: Annotated[Circle | None, CIRCLE_FLAG] = None
    """Only gallery images in this circle may answer. With --track it is where the flight began,
    when its first photo was taken."""
    track: bool = False
    """The photos are of one flight: each is placed in the light of all, and GeoJSON begins with the
    flight's line."""
    max_speed: float = 25.0
    "Of the flight, metres per second over the ground; 25 is beyond most multicopters."
    elsewhere: float = 0.1
    "Of the flight, the share of photos expected to show no place of the gallery."
    times: str | None = None
    """CSV table with the columns photo and time (seconds or ISO 8601); by default the camera's own
    times."""
    interval: float | None = None
    "Seconds between photos in the order of their names, where neither tables nor cameras say when."
    verify: bool = False
    """Look at every byte of the index first, and of the table's parts where it answers by their
    vectors."""
    calibration: str | None = None
    "What jobs/calibrate.py wrote; by default INDEX/calibration.json where it is there."
    csv: str | None = None
    "A CSV file with a row per photo."
    page: str | None = None
    "An HTML page with photos, candidates and a map, in one file that needs no network."
    shards: str | None = None
    """Those that the index was made of: the pictures of the page; needed besides where the index's
    embeddings are int8."""

    def __post_init__(self) -> None:
        if self.top < 1:
            raise InputError(f"--top is {self.top}, expected at least 1")
        if self.together and self.track:
            raise InputError(
                "both --together and --track were given, expected one: a track is of single photos; leave one out"
            )
        if self.interval is not None and not self.interval > 0:
            raise InputError(f"--interval is {self.interval}, expected seconds above 0")
        Motion(max_speed=self.max_speed, elsewhere=self.elsewhere)  # which checks them


def locate_photos(
    settings: Settings, true_positions: Mapping[str, LatLon] | None = None
) -> list[LocatedPhoto]:
    """Answer, write what was asked for, and return the answers in the order of the photos (of their
    folders, together).

    `true_positions`: where photos were really taken, by name, for the page. Raises InputError and CheckpointError on unusable input.
    """
    photos = find_photos(settings.photos)
    checkpoint = read_checkpoint_bytes(settings.checkpoint)
    index = Index(settings.index, whole=settings.verify or None)
    if settings.verify and index.told.refine == "table":
        for name in index.told.table_parts:
            verify_part(storage.join(index.told.table, name))
    confidence = load_calibration(settings, index)
    encoder = PhotoEncoder(checkpoint, settings.checkpoint, index.facts, settings.shards)
    gallery = read_gallery_map(index)
    queries = encode_photos(photos, encoder)
    if settings.together:
        queries = merge_by_folder(queries)
    asked = [query for query in queries if query.embedding_D is not None]
    if settings.track:
        asked = with_times(asked, settings)
    answers = answer_queries(asked, index, gallery, confidence, settings)
    answered = dict(
        zip((query.name for query in asked), zip(asked, answers, strict=True), strict=True)
    )
    located = [
        _located(*answered[query.name], settings.top)
        if query.name in answered
        else _located(query, None, settings.top)
        for query in queries
    ]
    if settings.track:
        located.sort(key=lambda one: (one.taken_at is None, parse_time(one.taken_at or "0")))
    about = {
        "index": settings.index, "fingerprint": encoder.fingerprint, "together": settings.together,
        "threshold": TRACK_THRESHOLD if settings.track else confidence.threshold if confidence else None,
    }  # fmt: skip
    storage.write_bytes(settings.out, geojson.to_geojson(located, about, settings.track))
    if settings.csv:
        storage.write_bytes(settings.csv, geojson.to_csv(located))
    if settings.page:
        around = PageContext(
            title="Where these photos were taken",
            gallery=gallery,
            confidence=confidence,
            fingerprint=encoder.fingerprint,
            track=settings.track,
            true_positions=true_positions or {},
        )
        storage.write_bytes(
            settings.page, make_page(located, around, settings.shards).encode("utf-8", "replace")
        )
    return located


def answer_queries(
    queries: Sequence[Query], index: Index, gallery: GalleryMap, confidence: Calibration | None, settings: Settings
) -> list[Answer]:  # fmt: skip
    """An answer per query, in the light of the whole flight with --track."""
    embeddings_QD = np.array([query.embedding_D for query in queries], np.float32).reshape(
        -1, index.dimension
    )
    near = settings.near
    if not settings.track or confidence is None:
        where = Filter(near=near) if near else None
        return locate_embeddings(
            index, embeddings_QD, settings.top, where, confidence, gallery.spacing_m
        )
    single = locate_embeddings(
        index, embeddings_QD, max(settings.top, TRACK_CANDIDATES), None, confidence
    )
    start = TrackStart(lat=near.lat, lon=near.lon, radius_m=near.radius_m) if near else None
    motion = motion_for_gallery(gallery, settings.max_speed, settings.elsewhere)
    return apply_track(
        single, [parse_time(query.taken_at or "0") for query in queries], confidence, motion, start
    )


def load_calibration(settings: Settings, index: Index) -> Calibration | None:
    """The calibration that was named, or the one beside the index, or none, which is said.

    Raises InputError where it is another network's, or where there is none and a track needs one.
    """
    if settings.calibration:
        return read_calibration(settings.calibration, index.facts)
    confidence = find_calibration(settings.index, index.facts)
    if confidence is None and settings.track:
        raise InputError(
            f"no calibration beside {settings.index}, and --track weighs candidates by one; expected calibration.json; make it "
            "with jobs/calibrate.py"
        )
    if confidence is None:
        console.print(
            "not calibrated: answers come without a probability, and none is unknown; see jobs/calibrate.py"
        )
    elif confidence.gallery != len(index):
        console.print(
            f"calibrated over {confidence.gallery} gallery images, the index has {len(index)}: probabilities are "
            "rough until jobs/calibrate.py is run again",
            style="yellow",
        )
    return confidence


def with_times(queries: Sequence[Query], settings: Settings) -> list[Query]:
    """The photos with when each was taken: by the table, else by the interval, else as the cameras
    say.

    Raises InputError where that is not known of all.
    """
    names = [query.name for query in queries]
    if settings.times:
        said = read_times(settings.times, names)
    elif settings.interval:
        said = {name: str(number * settings.interval) for number, name in enumerate(sorted(names))}
    else:
        said = {query.name: query.taken_at for query in queries if query.taken_at is not None}
    unknown = [name for name in names if name not in said]
    if unknown:
        raise InputError(
            f"{len(unknown)} of {len(names)} photos do not say when they were taken, {unknown[0]} among them; expected times "
            "for --track; give --times TABLE or --interval SECONDS"
        )
    return [replace(query, taken_at=said[query.name]) for query in queries]


def _located(query: Query, answer: Answer | None, top: int) -> LocatedPhoto:
    shown = replace(answer, candidates=answer.candidates[:top]) if answer else None
    return LocatedPhoto(
        name=query.name,
        photos=query.photos,
        answer=shown,
        rejected=query.rejected,
        taken_at=query.taken_at,
    )


def make_page(located: Sequence[LocatedPhoto], around: PageContext, shards: str | None) -> str:
    """The HTML page; with pictures and corners of the gallery's images where shards are at hand."""

    def photos(names: Iterable[str]) -> dict[str, bytes]:
        return {name: storage.read_bytes(name) for name in names}

    if shards is None:
        return render_page(located, around, photos, no_images)
    around = replace(around, footprints=partial(footprints, shards, read_manifest(shards)))
    return render_page(located, around, photos, partial(fetch, shards))


def print_answers(located: Sequence[LocatedPhoto]) -> None:
    """The answers on standard output, a line each."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading in ("photo", "position", "within", "sure", "location", "score"):
        table.add_column(
            heading,
            justify="left" if heading in ("photo", "location") else "right",
            overflow="fold",
        )
    for one in located:
        table.add_row(one.name, *_cells(one))
    results.print(table)


def _cells(one: LocatedPhoto) -> list[str]:
    answer = one.answer
    if answer is None:
        return [one.rejected[0].reason, "", "", "", ""]
    position = (
        f"{answer.position.lat:.6f}, {answer.position.lon:.6f}"
        if answer.position
        else "no position"
    )
    return [
        position if answer.known else "unknown",
        f"{answer.position.radius_m:.0f} m" if answer.position and answer.known else "",
        "" if answer.probability is None else f"{answer.probability:.0%}",
        (answer.location or "") if answer.known else "",
        f"{answer.candidates[0].score:.3f}" if answer.candidates else "",
    ]


def main(settings: Settings) -> None:
    """Answer where photos were taken: a position, how sure it is, and the candidates behind it."""
    located = locate_photos(settings)
    print_answers(located)
    results.print(
        f"answers: {settings.out}" + (f", page: {settings.page}" if settings.page else ""),
        soft_wrap=True,
    )
    damaged = [refused for one in located for refused in one.rejected]
    if damaged:
        raise Incomplete(
            f"{len(damaged)} of {sum(len(one.photos) for one in located)} photos could not be decoded: "
            f"{rejections.most_common_reasons(damaged)}; they are listed in {settings.out}"
        )


if __name__ == "__main__":
    run(main)
