"""Make a map to try everything on: `town.py --out DIR [--side 1000] [--seed 0]`"""

from jobs.command_line.cli import run
from pipeline.simulation.over_map.settings import TownMapSettings


def main(settings: TownMapSettings) -> None:
    """Make the map of a procedural town with its surface model, and the same town on another day:
    a region to try everything on without any data.
    """
    from pipeline.simulation.over_map.town_map import make_town_map

    make_town_map(settings)


if __name__ == "__main__":
    run(main)
