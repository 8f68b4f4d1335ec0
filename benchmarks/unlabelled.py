"""What adaptation without labels is worth: from trained weights, on views without pairs.

    python benchmarks/unlabelled.py --shards DIR --held NAME=DIR... --out DIR
        [--seeds 2] [--rounds 3] [--round-epochs 3] [--neighbours 4] [--alphas 0.1]

Trains the recipe `pvda_unlabelled` on the training split of `--shards` without its labels, once
without the adversary (alpha = 0) and once for each alpha with it, from each seed, and ranks UAV
photos against satellite images: those that were adapted to (`own`), and the test of each held set.
Prints a table: R@1 with its interval over places, the differences to the start and to alpha = 0,
paired by photo, each the mean of the seeds; and per round the share of the pseudo-pairs that are
right by the labels. It resumes: a finished training is kept.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from ingredients import change_cell, hits, named, share_cell

from jobs.training.driver import train
from jobs.training.recipes.pvda_unlabelled import pvda_unlabelled
from jobs.training.recipes.recipe import Recipe
from jobs.training.rounds import labels_file
from jobs.training.settings import TrainSettings
from model.weights.builtin import BUILTIN
from pipeline.core import parquet
from pipeline.core.arrays import Doubles, Strings
from pipeline.core.records import Split
from pipeline.shards.shard_set import open_shards

OWN, START, CONTROL = "own", "start", "alpha_zero"
Hits = dict[str, Doubles]
"Of each set: whether each photo finds its place first (Q,), or in how many of the seeds."


class Places:
    """The photos that are asked, and the images that are searched, by the name of their set."""

    def __init__(self, shards: str, held: list[tuple[str, str]], size: int) -> None:
        self._sets = {OWN: (shards, Split.TRAIN, Split.TRAIN)} | {
            name: (folder, Split.QUERY, Split.GALLERY) for name, folder in held
        }
        self._size = size
        self.places: dict[str, Strings] = {}

    def hits(self, checkpoint: str) -> Hits:
        """Whether each photo of each set finds its place first."""
        found: Hits = {}
        for name, (folder, asked, searched) in self._sets.items():
            found[name], self.places[name] = hits(checkpoint, folder, asked, searched, self._size)
        return found


def right_pairs(shards: str, run: Path, rounds: int) -> Doubles:
    """The share of each round's pseudo-pairs (R,) of which both images show one place."""
    location_of = open_shards(shards).column("location")
    shares = []
    for number in range(1, rounds + 1):
        pairs = parquet.read_table(labels_file(str(run), number)).to_pylist()
        right = [location_of[pair["drone"]] == location_of[pair["satellite"]] for pair in pairs]
        shares.append(np.mean(right))
    return np.array(shares)


def line(places: Places, found: Hits, *baselines: Hits) -> str:
    """The cells of a row: of each set R@1, and the difference to each baseline."""
    cells = ""
    for name, hit_Q in found.items():
        cells += share_cell(hit_Q, places.places[name])
        for baseline in baselines:
            cells += change_cell(hit_Q, baseline[name], places.places[name])
        cells += " |" * (2 - len(baselines))
    return cells


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shards", required=True)
    parser.add_argument("--held", required=True, nargs="+", type=named, help="NAME=DIR")
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--round-epochs", type=int, default=3)
    parser.add_argument("--batch-size", type=int, default=24)
    parser.add_argument("--image-size", type=int, default=128)
    parser.add_argument("--neighbours", type=int, default=4)
    parser.add_argument("--alphas", type=float, nargs="+", default=[0.1])
    options = parser.parse_args()
    base = pvda_unlabelled(options.rounds, options.round_epochs)
    base = replace(
        base,
        batch_size=options.batch_size,
        network=replace(base.network, image_size=options.image_size),
        pseudo_neighbours=options.neighbours,
    )
    rows: dict[str, Recipe] = {CONTROL: replace(base, adversary=False)}
    for alpha in options.alphas:
        schedule = replace(base.schedule, alpha=alpha, alpha_step=alpha)
        name = "with_the_adversary" if alpha == options.alphas[0] else f"alpha_{alpha:g}"
        rows[name] = replace(base, schedule=schedule)
    places = Places(options.shards, options.held, options.image_size)
    start = places.hits(BUILTIN)
    print(
        "| training |"
        + "".join(f" R@1 {name} | against the start | against alpha = 0 |" for name in start)
        + " pairs right, by round |\n|---|"
        + "---|---|---|" * len(start)
        + "---|"
    )
    print(f"| {START} |{line(places, start)} |", flush=True)
    control: Hits | None = None
    for name, recipe in rows.items():
        found, right = list[Hits](), list[Doubles]()
        for seed in range(options.seeds):
            run = options.out / f"{name}-{seed}"
            checkpoint = train(
                TrainSettings(
                    recipe=replace(recipe, seed=seed), shards=options.shards, out=str(run),
                    workers=0, probe_epochs=0,
                )
            )  # fmt: skip
            found.append(places.hits(checkpoint))
            right.append(right_pairs(options.shards, run, options.rounds))
        mean = {held: np.mean([one[held] for one in found], axis=0) for held in start}
        baselines = [start] if control is None else [start, control]
        shares = ", ".join(f"{share:.0%}" for share in np.mean(right, axis=0))
        print(f"| {name} |{line(places, mean, *baselines)} {shares} |", flush=True)
        control = control or mean


if __name__ == "__main__":
    main()
