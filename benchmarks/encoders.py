"""Encoders compared: UAV -> satellite retrieval of the test split of one set of shards.

    python benchmarks/encoders.py --shards DIR CHECKPOINT...     builtin, last.pt or .safetensors

Prints a row per checkpoint: R@1 with its interval over places, R@10, AP, and images/s. Embeds in
this process without Ray, so that a small set takes seconds.
"""

import argparse
import time
from itertools import islice
from typing import Any

import numpy as np
import torch

from jobs.encoding.encoder import read_checkpoint_bytes, trained_on_mirrors
from model.checkpoint import build_encoder, loads
from model.inference.embed import embed
from pipeline.batches.ordered import decode_samples, split_failed, stack
from pipeline.core.records import Split, View
from pipeline.retrieval.bootstrap import metrics_with_intervals
from pipeline.retrieval.embedding_set import EmbeddingSet, embedding_set_from_array
from pipeline.retrieval.metrics import recall_at
from pipeline.retrieval.ranking import rank
from pipeline.shards.shard_set import ShardSet, open_shards

BATCH = 32


def embed_view(
    shards: ShardSet, split: Split, view: View, checkpoint: str, size: int | None
) -> tuple[EmbeddingSet, float]:
    """Embeddings of a split's view, and the images a second of the network alone."""
    opened = loads(read_checkpoint_bytes(checkpoint), checkpoint)
    encoder = build_encoder(opened)
    mirror = trained_on_mirrors(opened)
    samples = (s for shard in shards.manifest.of(split, view) for s in shards.samples(shard))
    decoded = decode_samples(samples, size or opened.network.image_size, 2, 2 * BATCH)
    locations: list[str] = []
    rows, spent = [], 0.0
    while group := list(islice(decoded, BATCH)):
        intact, _ = split_failed(group)
        locations += [sample.metadata["location"] for sample, _ in intact]
        pixels_B3HW = torch.from_numpy(stack([image for _, image in intact]))
        start = time.perf_counter()
        rows.append(embed(encoder, pixels_B3HW, mirror).numpy())
        spent += time.perf_counter() - start
    keys = np.arange(len(locations)).astype(np.str_)
    found = embedding_set_from_array(keys, np.array(locations, np.str_), np.concatenate(rows))
    return found, len(locations) / spent


def retrieve(queries: EmbeddingSet, gallery: EmbeddingSet) -> dict[str, Any]:
    """R@1, R@10 and AP with intervals over places."""
    ranking = rank(queries, gallery, top=1)
    found = metrics_with_intervals(ranking.first_rank_Q, ranking.ap_Q, queries.locations)
    return found | {"r10": recall_at(10, ranking.first_rank_Q)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoints", nargs="+")
    parser.add_argument("--shards", required=True)
    parser.add_argument("--size", type=int, help="pixels a side, if not as trained")
    options = parser.parse_args()
    shards, baseline = open_shards(options.shards), None
    for checkpoint in options.checkpoints:
        queries, rate = embed_view(shards, Split.QUERY, View.DRONE, checkpoint, options.size)
        gallery, _ = embed_view(shards, Split.GALLERY, View.SATELLITE, checkpoint, options.size)
        found = retrieve(queries, gallery)
        baseline = baseline or rate
        low, high = found["r1_low"], found["r1_high"]
        photos, images = len(queries.locations), len(gallery.locations)
        print(
            f"{checkpoint}: R@1 {found['r1']:.1%} [{low:.1%}, {high:.1%}], R@10 {found['r10']:.1%},"
            f" AP {found['ap']:.1%}; {photos} photos in {images} images; "
            f"{rate:.0f} images/s, {rate / baseline:.2f} x the first encoder's"
        )


if __name__ == "__main__":
    main()
