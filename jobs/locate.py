"""Find where photos were taken: `locate.py PHOTO... --checkpoint FILE --index INDEX --out
FILE.geojson`

Writes GeoJSON, and on request CSV and a page with a map. Photos that cannot be decoded are listed
with the reason, the others are answered, and the exit code is 1.
"""

from jobs.command_line.cli import run
from jobs.stages.settings import LocateSettings


def main(settings: LocateSettings) -> None:
    """Find where photos were taken: a position, its probability, and the candidates behind it."""
    from jobs.stages.locate import locate

    locate(settings)


if __name__ == "__main__":
    run(main)
