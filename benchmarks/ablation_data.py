"""The data of `ablation.py`: simulated flights as shards, another sensor's look, the test set."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageFilter
from torch import Tensor

from jobs.training.probes import view_gap
from model.inference.embed import embed
from model.training import Training
from pipeline.batches.ordered import decode_samples
from pipeline.core.records import Split, View
from pipeline.retrieval.embedding_set import EmbeddingSet, embedding_set_from_array
from pipeline.retrieval.metrics import summarise
from pipeline.retrieval.ranking import rank
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.shards.shard_set import ShardSet
from pipeline.simulation.settings import SimulationSettings
from pipeline.simulation.simulate import simulate
from pipeline.sources.university1652 import University1652

IMAGE_SIZE = 64
PROBE_IMAGES = 256
"Images of each view that the probe of the gap between the views sees."


def make_shards(out: Path, name: str, other_sensor: bool = False, **counts: Any) -> str:
    """Pack simulated flights, unless an earlier call has; the folder of the shards."""
    shards = out / f"{name}-shards"
    if not (shards / "manifest.json").exists():
        root = simulate(SimulationSettings(out=str(out / f"{name}-flights"), size=96, **counts))
        if other_sensor:
            for path in root.glob("*/*satellite/*/*.jpg"):
                change_sensor(path)
        pack(University1652(), PackingSettings(root=str(root), out=str(shards)))
    return str(shards)


def change_sensor(path: Path) -> None:
    """Replace an image by its look from a hazier, duller, greener and softer camera."""
    with Image.open(path) as image:
        blurred = image.convert("RGB").filter(ImageFilter.GaussianBlur(0.8))
        soft_HW3 = np.asarray(blurred, np.float32) / 255
    grey_HW1 = soft_HW3.mean(2, keepdims=True)
    dull_HW3 = 0.35 * soft_HW3 + 0.65 * grey_HW1
    seen_HW3 = 0.3 + 0.55 * dull_HW3**1.3 * np.array([0.85, 1.1, 0.8], np.float32)
    Image.fromarray((255 * seen_HW3.clip(0, 1)).astype(np.uint8)).save(path, quality=90)


class TestSet:
    """The test images of a set, decoded once."""

    def __init__(self, shards: ShardSet) -> None:
        self.images: dict[tuple[Split, View], Tensor] = {}
        self.locations: dict[tuple[Split, View], np.ndarray] = {}
        for split in (Split.QUERY, Split.GALLERY):
            for view in (View.DRONE, View.SATELLITE):
                samples = [
                    pair
                    for shard in shards.manifest.of(split, view)
                    for pair in decode_samples(shards.samples(shard), IMAGE_SIZE, 2, 64)
                ]
                pixels = np.stack([image for _, image in samples if isinstance(image, np.ndarray)])
                self.images[split, view] = torch.from_numpy(pixels.transpose(0, 3, 1, 2))
                self.locations[split, view] = np.asarray(
                    [sample.metadata["location"] for sample, _ in samples], np.str_
                )

    def measure(self, training: Training) -> dict[str, float]:
        """R@1 and AP both ways, and the distance of the two views' mean unit embeddings."""
        encoder = training.model.encoder.eval()
        vectors = {
            key: torch.cat([embed(encoder, part) for part in torch.split(images, 128)]).numpy()
            for key, images in self.images.items()
        }
        encoder.train()

        def embedding_set(split: Split, view: View) -> EmbeddingSet:
            names = self.locations[split, view]
            return embedding_set_from_array(names, names, vectors[split, view])

        measures: dict[str, float] = {}
        for query, gallery, label in (
            (View.DRONE, View.SATELLITE, "d2s"),
            (View.SATELLITE, View.DRONE, "s2d"),
        ):
            ranking = rank(embedding_set(Split.QUERY, query), embedding_set(Split.GALLERY, gallery))
            scores = summarise(
                ranking.first_rank_Q, ranking.ap_Q, len(self.locations[Split.GALLERY, gallery])
            )
            measures |= {f"{label}_r1": scores.r1, f"{label}_ap": scores.ap}
        means = [vectors[Split.GALLERY, view].mean(0) for view in (View.DRONE, View.SATELLITE)]
        return measures | {"mean_distance": float(np.linalg.norm(means[0] - means[1]))}

    def gap(self, training: Training) -> dict[str, float]:
        """Accuracy of a new linear probe between the views of unseen places, on pooled maps."""
        encoder = training.model.encoder.eval()
        pooled = []
        with torch.no_grad():
            for view in (View.DRONE, View.SATELLITE):
                images = self.images[Split.GALLERY, view][:PROBE_IMAGES]
                parts = [encoder(part)[0].mean((2, 3)) for part in torch.split(images, 128)]
                pooled.append(torch.cat(parts).numpy())
        encoder.train()
        return view_gap(*pooled)
