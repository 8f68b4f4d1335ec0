"""Run every stage on one machine, from simulated flights to located photos: `demo.py [--out DIR]`

Simulate, pack, train, embed, index, evaluate, report, locate: the stages of the other jobs, on a
data set small enough for minutes on two cores. Run again, it resumes.
"""

from jobs.command_line.cli import run
from jobs.stages.settings import DemoSettings


def main(settings: DemoSettings) -> None:
    """Make a data set, train on it, and find locations never seen: minutes on two cores."""
    from jobs.stages.demo import demo

    demo(settings)


if __name__ == "__main__":
    run(main)
