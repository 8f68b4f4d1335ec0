"""UAV-VisLoc as its authors lay it out on disk -> ImageRecords: photos of each flight, and tiles
cut from its satellite map.

`<NN>/drone/*.JPG`, `<NN>/<NN>.csv` (num, filename, date, lat, lon, height, Omega, Kappa, Phi1, Phi2; one flight has none of the
angles), `<NN>/satellite<NN>.tif`, and `satellite_coordinates_range.csv` with the maps' corners.

A tile's location is its own name; a photo's location is the tile of its flight whose centre is
nearest to the ground that the photo shows. A photo without a readable position, or off its flight's
map, has no right answer and is refused.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import GeoTag, ImageRecord, Rejection, Split, View
from pipeline.images.inspect import is_image_name
from pipeline.sources.base import Source, not_an_image
from pipeline.sources.folders import require_images, wrong_folder
from pipeline.sources.maps.mosaic import Encoding, encode_window
from pipeline.sources.maps.tiles import parse_window
from pipeline.sources.text_tables import (
    Unreadable,
    parse_optional_number,
    parse_position,
    read_rows,
    unreadable_tag_row,
)
from pipeline.sources.visloc_maps import Corners, read_corners, read_maps

LAYOUT = "UAV-VisLoc's root, which holds satellite_coordinates_range.csv and <NN>/{drone/,satellite<NN>.tif,<NN>.csv}"


@dataclass(frozen=True, kw_only=True)
class VisLoc(Source):
    """UAV-VisLoc: photos of its flights, and tiles cut from their satellite maps."""

    tile_pixels: int = 1024
    """Side of a tile, pixels of the map. At its 0.3 m a pixel 1024 are about the ground that a
    photo shows."""
    overlap: float = 0.0
    "Share of a tile's side that its neighbour shows too, from 0 to below 1."
    encoding: Encoding = "jpg"
    "How tiles are written: jpg (quality 95) or png (exact, about five times as large)."
    train_flights: tuple[str, ...] = ()
    """Flights for training, such as 01 03: their photos, and the tiles that are locations of
    theirs. The data set has no division of its own. Of all other flights the photos are queries and
    all tiles are the gallery."""

    def __post_init__(self) -> None:
        if self.tile_pixels < 1:
            raise InputError(f"--tile-pixels is {self.tile_pixels}, expected at least 1")
        if not 0 <= self.overlap < 1:
            raise InputError(f"--overlap is {self.overlap}, expected a fraction from 0 to below 1")

    def read(self, record: ImageRecord) -> bytes:
        if not record.part:
            return super().read(record)
        return encode_window(record.path, parse_window(record.part), self.encoding)

    def ending(self, record: ImageRecord) -> str:
        return self.encoding if record.part else super().ending(record)

    def scan(self, root: str) -> Iterator[ImageRecord | Rejection]:
        return require_images(self._scan(root), root, LAYOUT)

    def _scan(self, root: str) -> Iterator[ImageRecord | Rejection]:
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

    def _flight(
        self, folder: str, flight: str, corners: dict[str, Corners]
    ) -> Iterator[ImageRecord | Rejection]:
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
        taken, rejected = read_photos(storage.join(folder, f"{flight}.csv"))
        yield from rejected
        used = set()
        for item in _photos(storage.join(folder, "drone")):
            if isinstance(item, Rejection):
                yield item
                continue
            path, size = item
            tag, date = taken.get(path.rsplit("/", 1)[-1].lower(), (None, None))
            if tag is None:
                yield Rejection(
                    path=path,
                    reason="no position",
                    found=f"no readable line of {flight}.csv names it",
                )
            elif not any(found.corners.holds(tag.lat, tag.lon) for found in maps):
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
                    taken_at=date,
                    bytes=size,
                )
        yield from (tile for tile in tiles if not train or tile.location in used)


class _NearestTile:
    """Number of the place that is nearest to another, of equals the first; a flight is small enough
    for a flat earth.
    """

    def __init__(self, places: list[GeoTag]) -> None:
        self.lats = np.array([place.lat for place in places])
        self.lons = np.array([place.lon for place in places])

    def __call__(self, tag: GeoTag) -> int:
        east = (self.lons - tag.lon) * np.cos(np.radians(tag.lat))
        return int(np.argmin((self.lats - tag.lat) ** 2 + east**2))


def _photos(folder: str) -> Iterator[tuple[str, int] | Rejection]:
    for path, size in storage.walk(folder).items():
        whole = storage.join(folder, path)
        if "/" in path:
            yield wrong_folder(whole, f"{path} is not drone/<image>")
        elif not is_image_name(path):
            yield not_an_image(whole)
        else:
            yield whole, size


def read_photos(path: str) -> tuple[dict[str, tuple[GeoTag, str | None]], list[Rejection]]:
    """Geotag and date by the photo's file name in lower case; of two lines for one name the first
    counts.

    Raises InputError when the table is missing or is none.
    """
    if not storage.exists(path):
        raise InputError(
            f"no {path}; expected the flight's table of positions; put it there or take the flight away"
        )
    photos: dict[str, tuple[GeoTag, str | None]] = {}
    rejected = []
    for line, row in read_rows(path, ("filename", "lat", "lon")):
        try:
            lat, lon = parse_position(row["lat"], row["lon"])
            height = parse_optional_number(row.get("height", ""))
            # Of the two yaw angles the authors call the first the more reliable one.
            heading = parse_optional_number(row.get("Phi1", ""))
            tag = GeoTag(
                lat=lat,
                lon=lon,
                altitude_m=height,
                heading_deg=None if heading is None else heading % 360,
            )
            photos.setdefault(
                row["filename"].strip().lower(), (tag, _parse_date(row.get("date", "")))
            )
        except Unreadable as error:
            rejected.append(unreadable_tag_row(path, line, ",".join(row.values()), error))
    return photos, rejected


def _parse_date(text: str) -> str | None:
    """ISO 8601, None for an empty cell. Raises Unreadable."""
    try:
        return (
            datetime.fromisoformat(text.strip().replace("/", "-")).isoformat()
            if text.strip()
            else None
        )
    except ValueError:
        raise Unreadable(f"date {text!r} is not ISO 8601") from None
