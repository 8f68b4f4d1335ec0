"""What each ingredient of the built-in encoder's training is worth, on places of other imagery.

    python benchmarks/ingredients.py --shards DIR --held NAME=DIR... --out DIR [--epochs 4]
        [--other-data NAME=DIR...] [--only NAME...]

Trains the recipe `builtin` for a few epochs, then again without one ingredient at a time, from the
same seed on the same number of images, and ranks the UAV photos of each held set's test against its
satellite images. Prints a table: R@1 with its interval over places, and the difference to the whole
recipe, paired by photo. `--other-data` trains the whole recipe on other shards, such as flights of
another kind. It resumes: a finished training is kept.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from encoders import embed_view

from jobs.training.driver import train
from jobs.training.recipes.builtin import builtin
from jobs.training.recipes.recipe import Recipe
from jobs.training.settings import TrainSettings
from model.config import LossWeights
from pipeline.core.arrays import Doubles, Strings
from pipeline.core.records import Split, View
from pipeline.images.augmentation import Augmentation
from pipeline.retrieval.bootstrap import confidence_intervals, paired_difference
from pipeline.retrieval.metrics import hits_at
from pipeline.retrieval.ranking import rank
from pipeline.shards.shard_set import open_shards

WHOLE = "all_ingredients"


def without(**changes: float | bool) -> Callable[[Recipe], Recipe]:
    """A recipe with other settings of its augmentation."""

    def change(recipe: Recipe) -> Recipe:
        settings = vars(recipe.augmentation) | changes
        return replace(recipe, augmentation=Augmentation(**settings))

    return change


INGREDIENTS: dict[str, Callable[[Recipe], Recipe]] = {
    WHOLE: lambda recipe: recipe,
    "random_weights_at_the_start": lambda recipe: replace(
        recipe, start="random", optimization=replace(recipe.optimization, frozen_stages=0)
    ),
    "without_InfoNCE": lambda recipe: replace(recipe, losses=LossWeights()),
    "without_the_location_loss": lambda recipe: replace(
        recipe, losses=replace(recipe.losses, location_weight=0.0)
    ),
    "one_ring": lambda recipe: replace(recipe, network=replace(recipe.network, parts=1)),
    "without_turns": without(rotation=0.0, drone_rotation=0.0),
    "without_scale_and_shift": without(scale=0.0, shift=0.0),
    "without_colours_and_haze": without(colour=0.0),
    "without_blur_noise_JPEG": without(blur=0.0, noise=0.0, jpeg=0.0),
    "without_hidden_parts": without(hide=0.0),
    "without_any_augmentation": without(
        rotation=0.0, drone_rotation=0.0, scale=0.0, shift=0.0, colour=0.0, blur=0.0, noise=0.0,
        jpeg=0.0, hide=0.0,
    ),
    "with_the_adversary": lambda recipe: replace(recipe, adversary=True),
}  # fmt: skip
"Row of the table -> the recipe's change."


def hits(
    checkpoint: str,
    shards_folder: str,
    asked: Split = Split.QUERY,
    searched: Split = Split.GALLERY,
    size: int | None = None,
) -> tuple[Doubles, Strings]:
    """Whether each photo of split `asked` finds its place first among the satellite images of
    `searched` (Q,), and the photos' places. `size`: side of the images, the network's where None.
    """
    shards = open_shards(shards_folder)
    queries = embed_view(shards, asked, View.DRONE, checkpoint, size).rows
    gallery = embed_view(shards, searched, View.SATELLITE, checkpoint, size).rows
    return hits_at(1, rank(queries, gallery, top=1).first_rank_Q), queries.locations


def share_cell(hit_Q: Doubles, places_Q: Strings) -> str:
    """R@1 with its interval over places."""
    [[low, high]] = confidence_intervals(hit_Q[:, None], places_Q).T
    return f" {hit_Q.mean():.1%} [{low:.1%}, {high:.1%}] |"


def change_cell(hit_Q: Doubles, baseline_Q: Doubles, places_Q: Strings) -> str:
    """The difference to a baseline, paired by photo, with its interval."""
    change = paired_difference(hit_Q, baseline_Q, places_Q)
    return f" {change.mean:+.1%} [{change.low:+.1%}, {change.high:+.1%}] |"


def named(argument: str) -> tuple[str, str]:
    name, _, folder = argument.partition("=")
    return name, folder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shards", required=True)
    parser.add_argument("--held", required=True, nargs="+", type=named, help="NAME=DIR")
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--epochs", type=int, default=4)
    parser.add_argument("--batch-size", type=int, default=24)
    parser.add_argument("--image-size", type=int, default=128)
    parser.add_argument("--other-data", nargs="*", type=named, default=[], help="NAME=DIR")
    parser.add_argument("--only", nargs="*", help="rows besides the first", default=None)
    options = parser.parse_args()
    rows = {
        name: (options.shards, change)
        for name, change in INGREDIENTS.items()
        if options.only is None or name in (WHOLE, *options.only)
    } | {name: (folder, INGREDIENTS[WHOLE]) for name, folder in options.other_data}
    base = builtin(options.epochs)
    base = replace(
        base,
        batch_size=options.batch_size,
        network=replace(base.network, image_size=options.image_size),
    )
    print("| training |" + "".join(f" R@1 {name} | difference |" for name, _ in options.held))
    print("|---|" + "---|---|" * len(options.held), flush=True)
    baselines: dict[str, Doubles] = {}
    for name, (shards, change) in rows.items():
        run = options.out / name
        checkpoint = train(
            TrainSettings(
                recipe=change(base), shards=shards, out=str(run), workers=0, probe_epochs=0
            )
        )
        line = f"| {name} |"
        for held, folder in options.held:
            hit_Q, places_Q = hits(checkpoint, folder)
            line += share_cell(hit_Q, places_Q)
            if held in baselines:
                line += change_cell(hit_Q, baselines[held], places_Q)
            else:
                baselines[held] = hit_Q
                line += " baseline |"
        print(line, flush=True)


if __name__ == "__main__":
    main()
