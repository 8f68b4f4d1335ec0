"""UAV-VisLoc as its authors distribute it -> ImageRecords: photos of each flight, and tiles cut
from its satellite map.

`<NN>/drone/*.JPG`, `<NN>/<NN>.csv` (num, filename, date, lat, lon, height, Omega, Kappa, Phi1,
Phi2; one flight has none of the angles), `<NN>/satellite<NN>.tif`, and
`satellite_coordinates_range.csv` with the maps' corners.

A tile's location is its own name; a photo's location is the tile of its flight whose centre is
nearest to the ground that the photo shows. A photo without a readable position, or off its flight's
map, has no right answer and is refused.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from pipeline.core import storage
from pipeline.core.errors import InputError, require
from pipeline.core.records import (
    GeoTag,
    ImageRecord,
    Rejection,
    Scanned,
    SkippedFile,
    Split,
    View,
)
from pipeline.images.inspect import is_image_name
from pipeline.sources.base import Source, not_an_image
from pipeline.sources.folders import require_images, wrong_folder
from pipeline.sources.maps.mosaic import Encoding, encode_window
from pipeline.sources.maps.tiles import parse_window
from pipeline.sources.text_tables import (
    TagTable,
    Unreadable,
    parse_optional_number,
    parse_position,
    read_rows,
    unreadable_tag_row,
)
from pipeline.sources.visloc_maps import Corners, read_corners, read_maps

_LAYOUT = (
    "UAV-VisLoc's root, which holds satellite_coordinates_range.csv and "
    "<NN>/{drone/,satellite<NN>.tif,<NN>.csv}"
)


@dataclass(frozen=True, kw_only=True)
class VisLoc(Source):
    """UAV-VisLoc: photos of its flights, and tiles cut from their satellite maps."""

    tile_pixels: int = 1024
    """Side of a tile, pixels of the map. At its 0.3 m a pixel 1024 are about the ground that a
    photo shows."""
    overlap: float = 0.0
    "Share of a tile's side that its neighbour shows too, from 0 to below 1."
    encoding: Encoding = "jpg"
    "Of tiles: jpg (quality 95) or png (exact, about five times as large)."
    train_flights: tuple[str, ...] = ()
    """Flights for training, such as 01 03: their photos, and the tiles that are their locations.
    The data set has no division of its own. Of all other flights the photos are queries and all
    tiles are the gallery."""

    def __post_init__(self) -> None:
        require(self.tile_pixels >= 1, "tile_pixels", self.tile_pixels, "at least 1")
        require(0 <= self.overlap < 1, "overlap", self.overlap, "a fraction from 0 to below 1")

    def read(self, record: ImageRecord) -> bytes:
        if not record.part:
            return super().read(record)
        return encode_window(record.path, parse_window(record.part), self.encoding)

    def ending(self, record: ImageRecord) -> str:
        return self.encoding if record.part else super().ending(record)

    def scan(self, root: str) -> Iterator[Scanned]:
        return require_images(self._scan(root), root, _LAYOUT)

    def _scan(self, root: str) -> Iterator[Scanned]:
        corners, rejected = read_corners(root)
        yield from rejected
        flights = [
            name
            for name in storage.list_names(root)
            if storage.is_folder(storage.join(root, name, "drone"))
        ]
        unknown = sorted(set(self.train_flights) - set(flights))
        if unknown:
            raise InputError(
                f"--train-flights names {', '.join(unknown)}, expected some of {', '.join(flights)}"
            )
        for flight in flights:
            yield from self._flight(storage.join(root, flight), flight, corners)

    def _flight(self, folder: str, flight: str, corners: dict[str, Corners]) -> Iterator[Scanned]:
        train = flight in self.train_flights
        maps, rejected = read_maps(folder, corners)
        yield from rejected
        tiles = [
            ImageRecord(
                path=found.path,
                part=window.part,
                split=Split.TRAIN if train else Split.GALLERY,
                view=View.SATELLITE,
                location=name,
                geotag=tag,
            )
            for found in maps
            for name, window, tag in found.tiles(self.tile_pixels, self.overlap)
        ]
        nearest = _NearestTile([tile.geotag for tile in tiles if tile.geotag])
        tags, dates, rejected = read_flight_table(storage.join(folder, f"{flight}.csv"))
        yield from rejected
        used = set()
        for item in _photos(storage.join(folder, "drone")):
            if not isinstance(item, tuple):
                yield item
                continue
            path, size = item
            name = path.rsplit("/", 1)[-1].lower()
            tag = tags.find(name)
            if tag is None:
                found = f"no readable line of {flight}.csv names it"
                yield Rejection(path=path, reason="no position", found=found)
            elif not any(found.corners.contains(tag.lat, tag.lon) for found in maps):
                yield Rejection(path=path, reason="off the map", found=f"{tag.lat}, {tag.lon}")
            else:
                tile = tiles[nearest(tag)]
                used.add(tile.location)
                yield ImageRecord(
                    path=path,
                    split=Split.TRAIN if train else Split.QUERY,
                    view=View.DRONE,
                    location=tile.location,
                    geotag=tag,
                    taken_at=dates[name],
                    bytes=size,
                )
        kept = [tile for tile in tiles if not train or tile.location in used]
        yield from kept
        if len(kept) < len(tiles):
            reason, count = "tile that no photo for training shows", len(tiles) - len(kept)
            yield SkippedFile(path=folder, reason=reason, count=count)


class _NearestTile:
    """Finds the position nearest to another one, the first of equals; a flight is small enough for
    a plane.
    """

    def __init__(self, tags: list[GeoTag]) -> None:
        self.lats = np.array([tag.lat for tag in tags])
        self.lons = np.array([tag.lon for tag in tags])

    def __call__(self, tag: GeoTag) -> int:
        east = (self.lons - tag.lon) * np.cos(np.radians(tag.lat))
        return int(np.argmin((self.lats - tag.lat) ** 2 + east**2))


def _photos(folder: str) -> Iterator[tuple[str, int] | Rejection | SkippedFile]:
    for path, size in storage.walk(folder).items():
        full_path = storage.join(folder, path)
        if not is_image_name(path):
            yield not_an_image(full_path)
        elif "/" in path:
            yield wrong_folder(full_path, f"{path} is not drone/<image>")
        else:
            yield full_path, size


def read_flight_table(path: str) -> tuple[TagTable, dict[str, str | None], list[Rejection]]:
    """Geotags and dates by the photo's file name in lower case, and the lines that could not be
    read or that contradict an earlier line.

    Raises InputError when the table is missing or is not one.
    """
    if not storage.exists(path):
        raise InputError(
            f"no {path}; expected the flight's table of positions; put it there or take the flight "
            "away"
        )
    tags, dates, rejected = TagTable(), dict[str, str | None](), []
    for line, row in read_rows(path, ("filename", "lat", "lon")):
        try:
            lat, lon = parse_position(row["lat"], row["lon"])
            height = parse_optional_number(row.get("height", ""))
            # Of the two yaw angles the authors call the first the more reliable one.
            heading = parse_optional_number(row.get("Phi1", ""))
            heading = None if heading is None else heading % 360
            date = _parse_date(row.get("date", ""))
            name = row["filename"].strip().lower()
            dates.setdefault(name, date)
            tags.add(name, GeoTag(lat=lat, lon=lon, altitude_m=height, heading_deg=heading))
        except Unreadable as error:
            rejected.append(unreadable_tag_row(path, line, ",".join(row.values()), error))
    return tags, dates, rejected


def _parse_date(text: str) -> str | None:
    """ISO 8601, None for an empty cell. Raises Unreadable."""
    try:
        date = text.strip().replace("/", "-")
        return datetime.fromisoformat(date).isoformat() if date else None
    except ValueError:
        raise Unreadable(f"date {text!r} is not ISO 8601") from None
