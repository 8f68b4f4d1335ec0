"""Another map for a region that stands: its tiles join the gallery, and the encoder stays.

In: a finished region and a map. Out: the same region over both. Finished parts are kept; a killed
extension is resumed by the same command.
"""

from dataclasses import replace
from typing import Any

from jobs.region.adapt import (
    FIGURES,
    camera_ranges,
    embed_tiles,
    expectation_table,
    fit_confidence,
    locate_command,
    note_localizer,
    pack_tiles,
    write_page,
)
from jobs.region.expect import located_outcomes, real_photos
from jobs.region.flights import EXPECT, plan_flights, take_flight
from jobs.region.folder import Region, check_map, print_command, with_absolute_paths
from jobs.region.maps import identify_map, join_surfaces, maps_of, with_one_file_each
from jobs.region.settings import AdaptSettings
from jobs.stages.demo import step
from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.lock import locks_output
from pipeline.core.progress import results
from pipeline.index.update import extend_index
from pipeline.region.expectation import Expectation, expectations, read_expectations
from pipeline.simulation.over_map.fly import TABLE


@locks_output(lambda settings: settings.out)
def extend_region(settings: AdaptSettings) -> list[Expectation]:
    """Add the map to the region, or what is missing of it; what to expect of all its maps.

    Raises InputError for a map that cannot be used, or a folder without a finished region.
    """
    settings = replace(with_absolute_paths(settings), extend=True)
    region = Region(out=settings.out)
    figures = _figures(region)
    check_map(settings)
    known = maps_of(figures)
    more = identify_map(settings.mosaic, settings.surface)
    if more.sha256 in {one.sha256 for one in known}:
        found = read_expectations(figures["expectations"])
        results.print(expectation_table(found))
        results.print(f"{region.out} holds {settings.mosaic}; nothing to do", soft_wrap=True)
        return found
    seconds: dict[str, float] = {}
    of_files = with_one_file_each(region, settings, known)
    flight = f"{EXPECT}-{more.sha256[:8]}"
    with step(seconds, "1 tiles", "the map's tiles, beside those that are there"):
        pack_tiles(region, of_files)
    with step(seconds, "2 flight", "simulated photos over it, to expect by"):
        *_, expect = plan_flights(region, of_files, camera_ranges(settings))
        # Over the whole of it, for none of it was learned.
        take_flight(replace(expect, part="all", out=region.path("flights", flight)))
    with step(seconds, "3 index", "the new tiles embedded and added"):
        embed_tiles(region)
        print_command("build_index", table=region.table, out=region.index, extend=True)
        extend_index(region.table, region.index)
    with step(seconds, "4 confidence", "fitted among all tiles"):
        surface = join_surfaces(region, of_files.surface, len(known))
        fit_confidence(region, surface)
    with step(seconds, "5 what to expect", "photos of all maps, located"):
        flights = [*figures["flights"], flight]
        tables = [region.path("flights", one, TABLE) for one in flights]
        outcomes = located_outcomes(region, surface, tables, settings.checks)
        real = real_photos(region, surface, settings.photos)
        found = expectations(outcomes)
    note_localizer(region, surface)
    write_page(region, settings, seconds, found, outcomes, real, [*known, more], flights)
    results.print(expectation_table([*found, *([real] if real else [])]))
    results.print(f"now: {locate_command(region)}", soft_wrap=True)
    return found


def _figures(region: Region) -> dict[str, Any]:
    path = region.path("expect", FIGURES)
    figures: dict[str, Any] = storage.read_json(path) if storage.exists(path) else {}
    if not maps_of(figures):
        raise InputError(
            f"no finished region at {region.out}, expected one to extend; adapt its first map "
            "without --extend"
        )
    return figures
