"""Simulate UAV photos over your own map: `fly.py --mosaic map.tif --out DIR [--photos N]
[--surface dsm.tif]`
"""

from jobs.command_line.cli import run
from pipeline.simulation.over_map.settings import MapFlightSettings


def main(settings: MapFlightSettings) -> None:
    """Take simulated UAV photos over a map, with their true positions: to calibrate, to test, and
    to learn what to expect before the first flight.
    """
    from pipeline.simulation.over_map.fly import fly

    fly(settings)


if __name__ == "__main__":
    run(main)
