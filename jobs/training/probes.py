"""Probes of training: the gap between the views, and retrieval of held-out locations.

In: an encoder and the training stream. Out: figures for the epoch's row. Never the test set: a run
selected by it would report the selection. Probing does not change the steps that follow.

Shapes: N images, B of a batch, C channels of the maps, E of an embedding.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
import torch

from model.inference.embed import unit_embedding
from model.pvda import FeatureEncoder
from pipeline.batches.ordered import Decoded, decode_samples, split_failed, stack
from pipeline.batches.training import TrainingStream
from pipeline.core.arrays import Floats
from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.retrieval.embedding_set import EmbeddingSet, embedding_set_from_array
from pipeline.retrieval.metrics import summarise
from pipeline.retrieval.ranking import rank

GAP_IMAGES = 256
"Images of each view for the view gap; half of them fit the probe, the other half test it."
BATCH = 32
RIDGE = 0.1
"Ridge penalty of the linear probe on standardised features, as a share of an image's squared norm."


@dataclass(frozen=True, kw_only=True)
class ProbeFeatures:
    """Features of some images of one view."""

    locations: list[str]
    pooled_NC: Floats
    "The maps averaged over their cells, from which the discriminator tells the views apart."
    embedding_NE: Floats


def probe(encoder: FeatureEncoder, stream: TrainingStream) -> dict[str, float]:
    """The view gap and, where locations are held out, the retrieval of these in either direction.

    Probes all images of the held-out locations; without any, the first training images, in the
    shards' order. Damaged images are left out. Raises InputError where that leaves no image of a
    view.
    """
    drone, satellite = (embed_view(encoder, stream, view) for view in (View.DRONE, View.SATELLITE))
    found = view_gap(drone.pooled_NC, satellite.pooled_NC)
    if stream.held_out:
        for name, queries, gallery in (
            ("drone_to_satellite", drone, satellite),
            ("satellite_to_drone", satellite, drone),
        ):
            ranking = rank(embedding_set(queries), embedding_set(gallery), top=1)
            scores = summarise(ranking.first_rank_Q, ranking.ap_Q, len(gallery.locations))
            found |= {f"held_out/{name}/r1": scores.r1, f"held_out/{name}/ap": scores.ap}
    return found


def embed_view(encoder: FeatureEncoder, stream: TrainingStream, view: View) -> ProbeFeatures:
    """Features of one view's images by the encoder as it is now, in evaluation mode meanwhile."""
    device = next(encoder.parameters()).device
    was_training, locations, pooled, embeddings = encoder.training, [], [], []
    images = probe_images(stream, view)
    encoder.eval()
    with torch.no_grad():
        while group := list(islice(images, BATCH)):
            decoded, _ = split_failed(group)
            if not decoded:
                continue
            maps_BCHW, g_BPD = encoder(
                torch.from_numpy(stack([image for _, image in decoded])).to(device)
            )
            locations += [sample.metadata["location"] for sample, _ in decoded]
            pooled.append(maps_BCHW.mean((2, 3)).float().cpu().numpy())
            embeddings.append(unit_embedding(g_BPD.float()).cpu().numpy())
    encoder.train(was_training)
    if not locations:
        raise InputError(
            f"not one {view} image of {stream.shards.path} that the probes look at can be decoded, "
            "expected some; pack again"
        )
    return ProbeFeatures(
        locations=locations,
        pooled_NC=np.concatenate(pooled),
        embedding_NE=np.concatenate(embeddings),
    )


def probe_images(stream: TrainingStream, view: View) -> Iterator[Decoded]:
    """The images to probe, preprocessed as in testing: resized, without augmentation."""
    config, held_out = stream.config, stream.held_out
    samples = (
        s
        for shard in stream.shards.manifest.of(Split.TRAIN, view)
        for s in stream.shards.samples(shard)
    )
    chosen = (
        (s for s in samples if s.metadata["location"] in held_out)
        if held_out
        else islice(samples, GAP_IMAGES)
    )
    return decode_samples(
        chosen, config.image_size, config.threads, 2 * BATCH, config.resizer, config.perspective
    )


def embedding_set(seen: ProbeFeatures) -> EmbeddingSet:
    keys = np.arange(len(seen.locations)).astype(np.str_)
    return embedding_set_from_array(keys, np.array(seen.locations, np.str_), seen.embedding_NE)


def view_gap(drone_NC: Floats, satellite_NC: Floats) -> dict[str, float]:
    """The gap between the views in the pooled maps.

    `accuracy`: of a linear probe (ridge regression on the views) that was fitted on half of the
    images, on the other half; 0.5 where the views cannot be told apart. `distance`: between the
    views' means, in units of the images' root mean square distance from their own view's mean.
    """
    count = min(len(drone_NC), len(satellite_NC), GAP_IMAGES)
    both_NC = np.concatenate([drone_NC[:count], satellite_NC[:count]]).astype(np.float64)
    view_N = np.repeat([-1.0, 1.0], count)
    means = [both_NC[view_N == sign].mean(0) for sign in (-1, 1)]
    spread = np.sqrt(
        np.mean(
            [((both_NC[view_N == s] - m) ** 2).sum(1) for s, m in zip((-1, 1), means, strict=True)]
        )
    )
    fitted_N = np.tile(np.arange(count) % 2 == 0, 2)
    scale_C = both_NC[fitted_N].std(0)
    standard_NC = (both_NC - both_NC[fitted_N].mean(0)) / np.where(scale_C > 0, scale_C, 1.0)
    fit_NC, test_NC = standard_NC[fitted_N], standard_NC[~fitted_N]
    kernel_NN = fit_NC @ fit_NC.T / fit_NC.shape[1] + RIDGE * np.eye(len(fit_NC))
    weight_C = fit_NC.T @ np.linalg.solve(kernel_NN, view_N[fitted_N])
    right_N = np.sign(test_NC @ weight_C) == view_N[~fitted_N]
    return {
        "view_gap/accuracy": float(right_N.mean()),
        "view_gap/distance": float(np.linalg.norm(means[1] - means[0]) / max(spread, 1e-12)),
    }
