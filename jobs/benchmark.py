"""Train and judge many methods by one road: `benchmark.py [--shards DIR] [--methods NAME...] --out
DIR`

Every method is trained from the same start at an equal budget of images, embedded and evaluated on
the same test. Writes OUT/leaderboard.html, .md and .json: both directions with intervals,
differences to the first method with p, costs, and the figures that papers published. A finished
training is kept: run again, it resumes.
"""

from jobs.command_line.cli import run
from jobs.stages.benchmark_settings import BenchmarkSettings


def main(settings: BenchmarkSettings) -> None:
    """Compare methods under one protocol and write the leaderboard."""
    from jobs.stages.benchmark import benchmark

    benchmark(settings)


if __name__ == "__main__":
    run(main)
