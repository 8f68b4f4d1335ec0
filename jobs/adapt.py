"""From a map to a localizer: `adapt.py --mosaic map.tif [--surface dsm.tif] [--photos DIR] --out
REGION [--minutes 20]`

Makes tiles, flies simulated UAVs over the map, fine-tunes the built-in encoder, builds the index,
fits its confidence, and writes REGION/what_to_expect.html. Then: `locate.py --index REGION/index
--out where.geojson PHOTO...`. A neighbouring map joins it by `adapt.py --extend --mosaic more.tif
--out REGION`.
"""

from jobs.command_line.cli import run
from jobs.region.settings import AdaptSettings


def main(settings: AdaptSettings) -> None:
    """Make a localizer of a map: tiles, an encoder that has learned the map, an index with a fitted
    confidence, and a page that says what to expect.
    """
    from jobs.region.adapt import adapt
    from jobs.region.extend import extend_region

    if settings.extend:
        extend_region(settings)
    else:
        adapt(settings)


if __name__ == "__main__":
    run(main)
