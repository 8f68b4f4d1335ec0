"""The encoder aligned with a UAV's own photos, of which no place is known: `pvda_unlabelled`.

In: the map, a folder of photos, an encoder to go on from. Out: a checkpoint. Photos with GPS are
not told apart: their positions are a test, never a label.
"""

from collections.abc import Sequence
from pathlib import Path

from jobs.region.folder import Region, print_command
from jobs.region.settings import AdaptSettings
from jobs.training.driver import train
from jobs.training.recipes.pvda_unlabelled import pvda_unlabelled
from jobs.training.settings import TrainSettings
from model.weights.builtin import BUILTIN
from pipeline.core import storage
from pipeline.core.arrays import evenly_spaced
from pipeline.core.progress import console
from pipeline.core.records import Split, View
from pipeline.locate.photo_files import find_photos
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.simulation.layout import write_table
from pipeline.sources.geotiff import GeoTiff
from pipeline.sources.table import Table

LEAST_PHOTOS, MOST_PHOTOS = 96, 480
"Four batches at least; evenly spaced ones of more."


def align(region: Region, settings: AdaptSettings, start: str) -> str | None:
    """Train from `start` on the map's tiles and the photos as views without pairs; the checkpoint.
    None, with a message, where there are too few photos.
    """
    photos = find_photos((settings.photos,)) if settings.photos else []
    if len(photos) < LEAST_PHOTOS:
        if photos:
            console.print(
                f"{len(photos)} photos set the camera; from {LEAST_PHOTOS} on the encoder is "
                "aligned with them too"
            )
        return None
    shards = pack_views(region, settings, photos)
    out = region.path("aligned")
    weights = None if start == BUILTIN else start  # the recipe begins with that one
    flags = {"weights": weights} if weights else {}
    print_command("train pvda_unlabelled", shards=shards, out=out, **flags)
    settings_of_run = TrainSettings(
        recipe=pvda_unlabelled(), shards=shards, weights=weights, workers=0, probe_epochs=0, out=out
    )
    return train(settings_of_run)


def pack_views(region: Region, settings: AdaptSettings, photos: Sequence[str]) -> str:
    """Tiles that do not overlap, and photos, as training images of one set: a tile beside another
    is another place, one that overlaps it is not quite."""
    out, table = region.path("views"), region.path("views.csv")
    if storage.exists(table):
        return out
    storage.remove_folder(out)  # of a run that was killed
    tiles = GeoTiff(tile_m=settings.tile_sides_m[0], split=Split.TRAIN)
    pack(tiles, PackingSettings(root=settings.mosaic, out=out))
    rows = [
        {
            "path": storage.absolute(photos[at]),
            "location": f"photo-{at}",
            "view": View.DRONE,
            "split": Split.TRAIN,
        }
        for at in evenly_spaced(len(photos), MOST_PHOTOS)
    ]
    listed = region.path("photos.csv")
    write_table(Path(listed), rows)
    pack(Table(), PackingSettings(root=listed, out=out, extend=True))
    Path(listed).rename(table)  # the set is complete
    return out
