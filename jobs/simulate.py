"""Simulated flights: `simulate.py --out DIR --train-locations N --test-locations N --distractors
N`.
"""

from jobs.command_line.cli import run
from pipeline.simulation.settings import SimulationSettings
from pipeline.simulation.simulate import simulate


def main(settings: SimulationSettings) -> None:
    """Make a data set in University-1652's layout: procedural towns, or flights over real overhead
    images.
    """
    simulate(settings)


if __name__ == "__main__":
    run(main)
