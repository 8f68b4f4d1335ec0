"""Simulate a data set of UAV flights: `simulate.py --out DIR --train-locations N --test-locations N
--distractors N`
"""

from jobs.command_line.cli import run
from pipeline.simulation.settings import SimulationSettings


def main(settings: SimulationSettings) -> None:
    """Make a data set in University-1652's layout: procedural towns, or flights over real overhead
    images.
    """
    from pipeline.simulation.simulate import simulate

    simulate(settings)


if __name__ == "__main__":
    run(main)
