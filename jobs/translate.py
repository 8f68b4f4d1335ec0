"""Make UAV images look like satellite images, by a GAN trained on the shards: `translate.py
--shards DIR --out DIR`

The second stage of PCL: UAV images, laid on the ground by their pose, are translated by a
conditional GAN that learns from the training places. `train.py pcl_style --shards OUT/shards` is
the third. A killed run resumes.
"""

from jobs.command_line.cli import run
from jobs.translation.settings import TranslateSettings


def main(settings: TranslateSettings) -> None:
    """Train the GAN, translate all UAV images, and pack them into OUT/shards."""
    from jobs.translation.stage import translate

    translate(settings)


if __name__ == "__main__":
    run(main)
