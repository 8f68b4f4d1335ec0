"""From a map to a localizer: every stage on one's own map, with simulated flights for photos.

In: a map, perhaps a surface model and photos. Out: a folder with tiles, encoder, index, calibration
and the page that says what to expect. The stages are those of the other jobs; run again, finished
ones are skipped.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from functools import partial

from rich import box
from rich.table import Table

from jobs.encoding.encoder import make_encoder_spec, read_checkpoint_bytes
from jobs.encoding.localizer import Localizer, write_localizer
from jobs.region.expect import located_outcomes, lookalikes, real_photos
from jobs.region.flights import CHECK, EXPECT, plan_flights, take_flight
from jobs.region.folder import Region, claim, print_command, with_absolute_paths
from jobs.region.maps import RegionMap, identify_map, maps_of, titles_of, with_one_file_each
from jobs.region.settings import AdaptSettings
from jobs.region.tuning import choose_encoder
from jobs.stages.calibrate import calibrate_index
from jobs.stages.demo import step
from jobs.stages.settings import CalibrateSettings
from pipeline.core import cluster, storage
from pipeline.core.errors import InputError
from pipeline.core.lock import locks_output
from pipeline.core.progress import console, results
from pipeline.features.embed import embed_gallery
from pipeline.features.settings import EmbeddingSettings
from pipeline.index.build import build_index
from pipeline.index.settings import IndexSettings
from pipeline.locate.photo_files import find_photos
from pipeline.region.camera_ranges import ranges_of_photos
from pipeline.region.expectation import (
    WITHIN_M,
    Expectation,
    Outcome,
    expectations,
    read_expectations,
)
from pipeline.region.page import RegionPage, render_region
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.shards.shard_set import open_shards
from pipeline.shards.tile_reader import TileReader
from pipeline.simulation.over_map.fly import TABLE
from pipeline.simulation.over_map.settings import CameraRanges
from pipeline.sources.geotiff import GeoTiff

OVERLAP = 0.5
PAGE, FIGURES = "what_to_expect.html", "figures.json"


@locks_output(lambda settings: settings.out)
def adapt(settings: AdaptSettings) -> list[Expectation]:
    """Make the region, or what is missing of it; what to expect of it.

    Raises InputError for a map that cannot be used, or a folder of another region.
    """
    settings = with_absolute_paths(settings)
    region = Region(out=settings.out)
    if not storage.is_local(region.out):
        raise InputError(
            f"--out is {settings.out}, expected a local or mounted folder; make it there and copy"
        )
    claim(region, settings, partial(is_finished, region, settings))
    figures = region.path("expect", FIGURES)
    if storage.exists(figures):
        found = read_expectations(storage.read_json(figures)["expectations"])
        results.print(expectation_table(found))
        results.print(f"{region.out} is complete; nothing to do", soft_wrap=True)
        return found
    seconds: dict[str, float] = {}
    cameras, of_files = camera_ranges(settings), with_one_file_each(region, settings)
    with step(seconds, "1 tiles", "the map as a gallery"):
        pack_tiles(region, of_files)
    with step(seconds, "2 flights", "simulated photos: to learn from, to check with, to expect by"):
        flights = [take_flight(one) for one in plan_flights(region, of_files, cameras)]
    with step(seconds, "3 encoder", "the built-in one, fine-tuned on this map"):
        choose_encoder(region, of_files, *flights[:2])
    with step(seconds, "4 index", "the tiles embedded and indexed"):
        embed_tiles(region)
        print_command("build_index", table=region.table, out=region.index)
        build_index(IndexSettings(table=region.table, out=region.index))
    with step(seconds, "5 confidence", "fitted on photos of places that were not learned"):
        fit_confidence(region, of_files.surface)
    with step(seconds, "6 what to expect", "other photos of such places, located"):
        tables = [storage.join(flights[3], TABLE)]
        outcomes = located_outcomes(region, of_files.surface, tables, settings.checks)
        real = real_photos(region, of_files.surface, settings.photos)
        found = expectations(outcomes)
    note_localizer(region, of_files.surface)
    maps = [identify_map(settings.mosaic, settings.surface)]
    write_page(region, settings, seconds, found, outcomes, real, maps, [EXPECT])
    results.print(expectation_table([*found, *([real] if real else [])]))
    results.print(
        f"what to expect: {region.path(PAGE)}\nnow: {locate_command(region)}", soft_wrap=True
    )
    return found


def is_finished(region: Region, settings: AdaptSettings) -> bool:
    """Whether the region was made to its end, of this map and surface model by their bytes."""
    path = region.path("expect", FIGURES)
    known = maps_of(storage.read_json(path)) if storage.exists(path) else []
    if not known:
        return False
    found = identify_map(settings.mosaic, settings.surface)
    return replace(found, name=known[0].name) == known[0]


def camera_ranges(settings: AdaptSettings) -> CameraRanges:
    """How the simulated UAV flies: as its photos' tags say, else by the settings."""
    if settings.photos is None:
        return settings
    found = ranges_of_photos(find_photos((settings.photos,)), settings)
    console.print(
        f"{settings.photos}: {found.height[0]:.0f} to {found.height[1]:.0f} m high, pitch "
        f"{found.pitch[0]:.0f} to {found.pitch[1]:.0f}, field of view "
        f"{found.fov_range[0]:.0f} to {found.fov_range[1]:.0f} degrees",
        markup=False,
    )
    return found


def pack_tiles(region: Region, settings: AdaptSettings) -> None:
    """The map's tiles; beside those that are there, where another map is added."""
    more = {"extend": True} if settings.extend else {}
    print_command("make_shards", source="geotiff", root=settings.mosaic, out=region.tiles,
             tile_m=settings.tile_m, overlap=OVERLAP, **more)  # fmt: skip
    cluster.connect()
    source = GeoTiff(tile_m=settings.tile_sides_m, overlap=OVERLAP)
    packing = PackingSettings(root=settings.mosaic, out=region.tiles, extend=settings.extend)
    pack(source, packing)


def embed_tiles(region: Region) -> None:
    """The tiles that have no row of the feature table yet."""
    print_command(
        "embed_gallery", shards=region.tiles, checkpoint=region.encoder, out=region.table, workers=0
    )
    # The tiles are of our own making: nothing that a worker has to be risked for.
    embedding = EmbeddingSettings(shards=region.tiles, out=region.table, workers=0)
    data = read_checkpoint_bytes(region.encoder)
    embed_gallery(embedding, make_encoder_spec(data, region.encoder, embedding))


def fit_confidence(region: Region, surface: str | None) -> None:
    """The calibration, by the flight that is there for it; again where the gallery has changed."""
    flight = region.path("flights", CHECK, TABLE)
    fitting = CalibrateSettings(
        checkpoint=region.encoder, shards=region.tiles, index=region.index, flight=flight,
        surface=surface,
    )  # fmt: skip
    heights = {} if surface is None else {"surface": surface}
    print_command("calibrate", checkpoint=region.encoder, shards=region.tiles,
                  index=region.index, flight=flight, **heights)  # fmt: skip
    calibrate_index(fitting)


def note_localizer(region: Region, surface: str | None) -> None:
    """Say beside the index what belongs to it."""
    belongs = Localizer(checkpoint=region.encoder, shards=region.tiles, surface=surface)
    write_localizer(region.index, belongs)


def locate_command(region: Region) -> str:
    return f"pvda locate --index {region.index} --out where.geojson --page where.html PHOTO..."


def write_page(
    region: Region,
    settings: AdaptSettings,
    seconds: dict[str, float],
    found: list[Expectation],
    outcomes: list[Outcome],
    real: Expectation | None,
    maps: Sequence[RegionMap],
    flights: Sequence[str],
) -> None:
    """Write the page, and the figures, by which the region counts as complete for these maps."""
    page = RegionPage(
        name=" and ".join(titles_of(maps)),
        flat=settings.surface is None,
        expectations=found,
        real=real,
        outcomes=outcomes,
        lookalikes=lookalikes(region, settings.tile_sides_m),
        seconds=seconds,
        commands=[locate_command(region)],
    )

    def load_photos(paths: Iterable[str]) -> dict[str, bytes]:
        return {path: storage.read_bytes(path) for path in paths}

    html = render_region(page, load_photos, TileReader(open_shards(region.tiles)).fetch)
    storage.write_bytes(region.path(PAGE), html.encode())
    rows = [*found, *([real] if real else [])]
    figures = {
        "maps": [asdict(one) for one in maps],
        "flights": list(flights),
        "expectations": [asdict(one) for one in rows],
        "outcomes": [asdict(one) for one in outcomes],
    }
    storage.write_json(region.path("expect", FIGURES), figures)


def expectation_table(rows: Sequence[Expectation]) -> Table:
    """The figures for the terminal."""
    table = Table(title="photos of places not learned", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    headings = [
        "photos",
        "answered",
        *(f"<= {metres:g} m" for metres in WITHIN_M),
        "wrong",
        "median",
    ]
    for number, heading in enumerate(headings):
        table.add_column(heading, justify="right" if number else "left", no_wrap=True)
    for row in rows:
        shares = (row.answered, *row.within, row.wrong)
        cells = ["-" if math.isnan(one.value) else f"{one.value:.1%}" for one in shares]
        table.add_row(f"{row.photos} {row.title}", *cells, f"{row.median_m:.2f} m")
    return table
