"""Find where photos were taken: `locate.py PHOTO... --checkpoint FILE --index INDEX --out
FILE.geojson`

Embeds photos, or folders of them, as the index's images were embedded, and searches the index.
Writes GeoJSON, and on request CSV and a page with a map. Photos that cannot be decoded are listed
with the reason, the others are answered, and the exit code is 1.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from jobs.encoding.encoder import read_checkpoint_bytes
from jobs.encoding.localizer import with_localizer
from jobs.encoding.photo_encoder import PhotoEncoder
from jobs.encoding.queries import Query, ViewMaker, encode_photos, merge_by_folder, one_view
from jobs.stages.flight import locate_flight, search_queries, with_times
from jobs.stages.matching import open_map, overhead_maker, refine_answers, view_maker
from jobs.stages.settings import LocateSettings
from pipeline.camera.pose import Perspective
from pipeline.core import storage
from pipeline.core.errors import Incomplete, InputError
from pipeline.core.filters import Filter
from pipeline.core.progress import console, results
from pipeline.core.rejections import most_common_reasons
from pipeline.features.part import verify_part
from pipeline.images.thumbnails import no_images
from pipeline.index.searcher import Index
from pipeline.locate.answer_table import answer_table
from pipeline.locate.calibration import Calibration, find_calibration, read_calibration
from pipeline.locate.flight import TRACK_THRESHOLD
from pipeline.locate.gallery_map import GalleryMap, read_gallery_map
from pipeline.locate.geojson import LocatedPhoto, to_csv, to_geojson
from pipeline.locate.locate import CONSENSUS_CANDIDATES, Answer
from pipeline.locate.page import LatLon, PageContext, render_page
from pipeline.locate.photo_files import find_photos, parse_time
from pipeline.matching.map_windows import MapWindows
from pipeline.shards.shard_set import open_shards
from pipeline.shards.tile_reader import TileReader


def locate_photos(
    settings: LocateSettings, true_positions: Mapping[str, LatLon] | None = None
) -> list[LocatedPhoto]:
    """Answer, write the files asked for, and return the answers in the order of the photos (of
    their folders with --together; of their times with --track).

    `true_positions`: where photos were taken, by name, for the page. Raises InputError and
    CheckpointError on unusable input.
    """
    settings = with_localizer(settings)
    photos = find_photos(settings.photos)
    checkpoint = read_checkpoint_bytes(settings.checkpoint)
    index = Index(settings.index, verify=settings.verify or None)
    if settings.verify and index.metadata.refine == "table":
        for name in index.metadata.table_parts:
            verify_part(storage.join(index.metadata.table, name))
    calibration = load_calibration(settings, index)
    encoder = PhotoEncoder(
        checkpoint,
        settings.checkpoint,
        index.metadata.fingerprint,
        index.metadata.encoding,
        images=len(photos),
    )
    gallery = read_gallery_map(index)
    windows = _open_map(settings, gallery)
    perspective = encoder.encoding.perspective
    queries = encode_photos(photos, encoder, _view_maker(settings, gallery, windows, perspective))
    if settings.together:
        queries = merge_by_folder(queries)
    decoded = [query for query in queries if query.views_VD is not None]
    if settings.track and calibration is not None:
        decoded = with_times(decoded, settings)
        answers = locate_flight(decoded, index, gallery, calibration, windows, settings)
    else:
        answers = answer_queries(decoded, index, gallery, calibration, settings)
        if windows:
            answers = refine_answers(decoded, answers, windows, settings, calibration)
    by_name = {
        query.name: _located(query, answer, settings.top)
        for query, answer in zip(decoded, answers, strict=True)
    }
    located = [by_name.get(query.name) or _located(query, None, 0) for query in queries]
    if settings.track:
        located.sort(key=lambda one: (one.taken_at is None, parse_time(one.taken_at or "0")))
    context = PageContext(
        title="Where these photos were taken",
        gallery=gallery,
        calibration=calibration,
        fingerprint=encoder.fingerprint,
        track=settings.track,
        matched=windows is not None,
        true_positions=true_positions or {},
    )
    write_answers(located, settings, context)
    return located


def _open_map(settings: LocateSettings, gallery: GalleryMap) -> MapWindows | None:
    """The map's pixels, if photos are to be matched: several as one query have no pixels."""
    if settings.shards is None or settings.together or not settings.match:
        return None
    whole_map = settings.whole_map and (settings.near is None or settings.track)
    return open_map(
        settings.shards, gallery, settings.index, settings.surface, whole_map, settings.dense
    )


def _view_maker(
    settings: LocateSettings,
    gallery: GalleryMap,
    windows: MapWindows | None,
    perspective: Perspective,
) -> ViewMaker:
    """How the encoder is shown photos: framed as the gallery's tiles are, where their size is
    known; several of one place as they are."""
    if windows is None and perspective == "overhead":
        return overhead_maker(settings)
    sides_m = windows.tile_sides_m() if windows else gallery.level_sides_m
    if not sides_m or settings.together:
        return one_view
    return view_maker(sides_m, settings)


def answer_queries(
    queries: Sequence[Query],
    index: Index,
    gallery: GalleryMap,
    calibration: Calibration | None,
    settings: LocateSettings,
) -> list[Answer]:
    """One answer per query, by tiles, each by itself."""
    near = settings.near
    # Matching tries more candidates than are listed.
    k, where = max(settings.top, CONSENSUS_CANDIDATES), Filter(near=near) if near else None
    return search_queries(queries, index, gallery, calibration, k, where)


def load_calibration(settings: LocateSettings, index: Index) -> Calibration | None:
    """The calibration named by --calibration, or the one beside the index; None, with a message,
    where there is none.

    Raises InputError where it belongs to another encoder, or is missing and a track needs one.
    """
    if settings.calibration:
        return read_calibration(settings.calibration, index.metadata.fingerprint)
    calibration = find_calibration(settings.index, index.metadata.fingerprint)
    if calibration is None and settings.track:
        raise InputError(
            f"no calibration beside {settings.index}, and --track weighs candidates by one; "
            "expected calibration.json; make it with jobs/calibrate.py"
        )
    if calibration is None:
        console.print(
            "not calibrated: answers come without a probability, and none is unknown; see "
            "jobs/calibrate.py"
        )
    elif calibration.gallery_rows != len(index):
        console.print(
            f"calibrated over {calibration.gallery_rows} gallery images, the index has "
            f"{len(index)}: probabilities are rough until jobs/calibrate.py is run again",
            style="yellow",
        )
    return calibration


def _located(query: Query, answer: Answer | None, top: int) -> LocatedPhoto:
    listed = replace(answer, candidates=answer.candidates[:top]) if answer else None
    return LocatedPhoto(
        name=query.name,
        photos=query.photos,
        answer=listed,
        rejected=query.rejected,
        taken_at=query.taken_at,
    )


def write_answers(
    located: Sequence[LocatedPhoto], settings: LocateSettings, context: PageContext
) -> None:
    """Write the GeoJSON, and the CSV and the page where they were asked for."""
    calibration, matching = context.calibration, context.matching
    of_tiles = matching.tile_threshold if matching else calibration and calibration.threshold
    about = {
        "index": settings.index,
        "fingerprint": context.fingerprint,
        "together": settings.together,
        "threshold": TRACK_THRESHOLD if settings.track else of_tiles,
    }
    storage.write_bytes(settings.out, to_geojson(located, about, settings.track))
    if settings.csv:
        storage.write_bytes(settings.csv, to_csv(located))
    if settings.page:
        page = make_page(located, context, settings.shards)
        storage.write_bytes(settings.page, page.encode("utf-8", "replace"))


def make_page(located: Sequence[LocatedPhoto], context: PageContext, shards: str | None) -> str:
    """The HTML page; with images and corners of the gallery's images where there are shards."""

    def load_photos(paths: Iterable[str]) -> dict[str, bytes]:
        return {path: storage.read_bytes(path) for path in paths}

    if shards is None:
        return render_page(located, context, load_photos, no_images)
    tiles = TileReader(open_shards(shards))
    context = replace(context, footprints=tiles.footprints)
    return render_page(located, context, load_photos, tiles.fetch)


def locate(settings: LocateSettings) -> None:
    """Find where photos were taken: a position, its probability, and the candidates behind it."""
    located = locate_photos(settings)
    results.print(answer_table(located))
    written = f"answers: {settings.out}" + (f", page: {settings.page}" if settings.page else "")
    results.print(written, soft_wrap=True)
    rejected = [rejection for one in located for rejection in one.rejected]
    if rejected:
        total, reasons = sum(len(one.photos) for one in located), most_common_reasons(rejected)
        raise Incomplete(
            f"{len(rejected)} of {total} photos could not be decoded: {reasons}; they are listed "
            f"in {settings.out}"
        )
