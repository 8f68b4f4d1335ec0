"""The simulated flights of a region: to learn from, to check with, and to expect by."""

from dataclasses import asdict, replace

from jobs.region.folder import Region, print_command
from jobs.region.settings import AdaptSettings
from pipeline.core import storage
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.simulation.over_map.fly import TABLE, fly
from pipeline.simulation.over_map.settings import CameraRanges, MapFlightSettings
from pipeline.sources.table import Table

LEARN, CHOOSE, CHECK, EXPECT = "learn", "choose", "check", "expect"
"Folders of the flights."
VIEWS = 4
"Photos of each place to learn from."
PLACES_PER_MINUTE, LEAST_PLACES, MOST_PLACES = 20, 48, 400
"To learn from: training sees each of them some twenty times."
LEARN_PX = 256
"Side of a photo to learn from: the encoder sees 128."
CHECK_PX = 512
"Side of a photo that the confidence is fitted on, or that tells what to expect."
TESTED_PLACES = 60
"Held-out places that choose between the encoder before and after training."


def plan_flights(
    region: Region, settings: AdaptSettings, cameras: CameraRanges
) -> list[MapFlightSettings]:
    """The flights: pairs to learn from, pairs that choose the encoder, photos that confidence is
    fitted on, and photos that tell what to expect. Each has days of its own."""
    base = MapFlightSettings(
        mosaic=settings.mosaic, surface=settings.surface, out="", part="held-out",
        photos=settings.checks, size=CHECK_PX, height=cameras.height, pitch=cameras.pitch,
        fov=cameras.fov, camera=cameras.camera,
    )  # fmt: skip
    pairs = replace(base, overhead_m=settings.tile_sides_m[0], size=LEARN_PX)
    places = min(MOST_PLACES, max(LEAST_PLACES, round(settings.minutes * PLACES_PER_MINUTE)))
    flights = {
        LEARN: replace(pairs, part="learn", photos=places * VIEWS, views=VIEWS),
        CHOOSE: replace(pairs, photos=2 * TESTED_PLACES, views=2),
        CHECK: base,
        EXPECT: base,
    }
    return [
        replace(flight, out=region.path("flights", name), seed=10 * settings.seed + number)
        for number, (name, flight) in enumerate(flights.items())
    ]


def take_flight(flight: MapFlightSettings) -> str:
    told = {name: value for name, value in asdict(flight).items() if value is not None}
    default = asdict(MapFlightSettings(mosaic="", out=""))
    print_command("fly", **{name: told[name] for name in told if told[name] != default[name]})
    return str(fly(flight))


def pack_pairs(flight: str) -> str:
    """A flight's pairs as shards."""
    out = f"{flight}-shards"
    root = storage.join(flight, TABLE)
    print_command("make_shards", source="table", root=root, out=out)
    pack(Table(), PackingSettings(root=root, out=out))
    return out
