"""Encoders compared: UAV -> satellite retrieval of the test split of one set of shards.

    python benchmarks/encoders.py --shards DIR CHECKPOINT...     builtin, last.pt or .safetensors

Prints a row per checkpoint and precision: R@1 with its interval over places, and its difference to
the first row's, paired by photo; R@10, AP, and images/s. `float32:int8` has photos in float32 and
the gallery in int8. Embeds in this process without Ray, so that a small set takes seconds.
"""

import argparse
import time
from dataclasses import dataclass
from itertools import islice, permutations, product
from typing import Any

import numpy as np
import torch

from jobs.encoding.encoder import read_checkpoint_bytes, trained_on_mirrors
from jobs.encoding.probe_images import CALIBRATION_IMAGES, PROBE_IMAGES, first_images
from model.checkpoint import build_encoder, loads
from model.inference.optimise import MIN_COSINE, optimise_encoder
from model.inference.precision import Precision
from pipeline.batches.ordered import decode_samples, split_failed, stack
from pipeline.core.arrays import Doubles
from pipeline.core.records import Split, View
from pipeline.retrieval.bootstrap import metrics_with_intervals, paired_difference
from pipeline.retrieval.embedding_set import EmbeddingSet, embedding_set_from_array
from pipeline.retrieval.metrics import hits_at, recall_at
from pipeline.retrieval.ranking import rank
from pipeline.shards.shard_set import ShardSet, open_shards

BATCH = 32


@dataclass(frozen=True, kw_only=True)
class EmbeddedView:
    """Embeddings, the images a second of the network alone, and its mean cosine with the plain
    one's over the images that check it.
    """

    rows: EmbeddingSet
    images_per_second: float
    agreement: float


def embed_view(
    shards: ShardSet,
    split: Split,
    view: View,
    checkpoint: str,
    size: int | None = None,
    precision: Precision = "float32",
) -> EmbeddedView:
    """A split's view, embedded. `size`: side of the images, the network's where None."""
    opened = loads(read_checkpoint_bytes(checkpoint), checkpoint)
    side = size or opened.network.image_size
    chosen_B3HW = torch.from_numpy(
        first_images(shards, side, "torch", PROBE_IMAGES + CALIBRATION_IMAGES)
    )
    samples = (s for shard in shards.manifest.of(split, view) for s in shards.samples(shard))
    decoded = decode_samples(samples, side, 2, 2 * BATCH)
    locations: list[str] = []
    rows, spent, fast = [], 0.0, None
    while group := list(islice(decoded, BATCH)):
        intact, _ = split_failed(group)
        locations += [sample.metadata["location"] for sample, _ in intact]
        pixels_B3HW = torch.from_numpy(stack([image for _, image in intact]))
        fast = fast or optimise_encoder(
            build_encoder(opened),
            probe_B3HW=chosen_B3HW[:PROBE_IMAGES],
            calibration_B3HW=chosen_B3HW[PROBE_IMAGES:],
            batch_size=BATCH,
            precision=precision,
            mirror=trained_on_mirrors(opened),
            images=sum(shard.samples for shard in shards.manifest.of(split, view)),
            log=lambda _: None,
        )
        start = time.perf_counter()
        rows.append(fast(pixels_B3HW).numpy())
        spent += time.perf_counter() - start
    if fast is None:
        raise SystemExit(f"{shards.path} has no images of {split} {view}")
    keys = np.arange(len(locations)).astype(np.str_)
    return EmbeddedView(
        rows=embedding_set_from_array(keys, np.array(locations, np.str_), np.concatenate(rows)),
        images_per_second=len(locations) / spent,
        agreement=fast.mean_agreement,
    )


def retrieve(queries: EmbeddingSet, gallery: EmbeddingSet) -> dict[str, Any]:
    """R@1, R@10 and AP with intervals over places, and which photos are right."""
    ranking = rank(queries, gallery, top=1)
    found = metrics_with_intervals(ranking.first_rank_Q, ranking.ap_Q, queries.locations)
    hit_Q = hits_at(1, ranking.first_rank_Q)
    return found | {"r10": recall_at(10, ranking.first_rank_Q), "hits": hit_Q}


def precisions_of(argument: str) -> tuple[Precision, Precision]:
    """Of photos and of the gallery."""
    photos, _, gallery = argument.partition(":")
    known: dict[str, Precision] = {name: name for name in MIN_COSINE}
    return known[photos], known[gallery or photos]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoints", nargs="+")
    parser.add_argument("--shards", required=True)
    choices = [*MIN_COSINE, *map(":".join, permutations(MIN_COSINE, 2))]
    parser.add_argument("--precisions", nargs="+", default=["float32"], choices=choices)
    parser.add_argument("--size", type=int, help="pixels a side, if not as trained")
    options = parser.parse_args()
    shards, baseline = open_shards(options.shards), None
    # One that agrees less than a job asks for is judged as well.
    MIN_COSINE.update({"bfloat16": -1, "int8": -1})
    first_hit_Q: Doubles | None = None
    for checkpoint, precision in product(options.checkpoints, options.precisions):
        of_photos, of_gallery = precisions_of(precision)
        encoder = (checkpoint, options.size)
        queries = embed_view(shards, Split.QUERY, View.DRONE, *encoder, of_photos)
        gallery = embed_view(shards, Split.GALLERY, View.SATELLITE, *encoder, of_gallery)
        found = retrieve(queries.rows, gallery.rows)
        rate = queries.images_per_second
        baseline = baseline or rate
        first_hit_Q = found["hits"] if first_hit_Q is None else first_hit_Q
        change = paired_difference(found["hits"], first_hit_Q, queries.rows.locations)
        low, high = found["r1_low"], found["r1_high"]
        photos, images = len(queries.rows.locations), len(gallery.rows.locations)
        print(
            f"{checkpoint}, {precision}: R@1 {found['r1']:.1%} [{low:.1%}, {high:.1%}], to the "
            f"first {change.mean:+.2%} [{change.low:+.2%}, {change.high:+.2%}], "
            f"R@10 {found['r10']:.1%}, AP {found['ap']:.1%}; {photos} photos in {images} images; "
            f"cosine with the plain encoder {queries.agreement:.5f}; "
            f"{rate:.0f} images/s, {rate / baseline:.2f} x the first encoder's"
        )


if __name__ == "__main__":
    main()
