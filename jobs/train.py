"""Train PVDA by a recipe: `train.py RECIPE --shards DIR --out RUN [--weights FILE] [--workers N]`

Writes RUN/last.pt (weights, config, and all that resuming needs), RUN/config.yaml (the settings),
RUN/metrics.jsonl (a row per epoch) and RUN/tensorboard. A killed run resumes from its last
checkpoint when the same command runs again; where a Ray worker dies, by itself.
"""

from jobs.command_line.cli import run
from jobs.training.settings import RECIPE, RUN_CONFIG_FILE, TrainSettings


def main(settings: TrainSettings) -> None:
    """Train PVDA by a recipe; its settings can be overridden by flags of their names."""
    from jobs.training.driver import train

    train(settings)


if __name__ == "__main__":
    run(main, RECIPE, like_file=RUN_CONFIG_FILE)
