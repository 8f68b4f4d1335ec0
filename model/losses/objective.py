"""The objective: the weighted sum of the losses that a recipe asks for, and what they learn.

In: what the networks make of a step's images, of both views. Out: the scalar that encoder and
classifier minimise, and each loss by its name. The adversary's term is not in it: `Training.step`
adds it to every objective alike. Shapes: B images of a view, P parts, V views.
"""

import math

import torch
from torch import Tensor, nn

from model.config import LossWeights, PVDAConfig
from model.inference.embed import unit_embedding
from model.losses.auxiliary import AlignmentMaps, GateHeads, RegionContrast
from model.losses.consistency import dense_alignment, view_js, view_kl
from model.losses.contrastive import info_nce
from model.losses.metric import cross_view_triplet, multi_similarity
from model.losses.pvda import location_terms
from model.two_views import ViewOutput

VIEWS = ("drone", "satellite")


class Objective(nn.Module):
    """The losses of a recipe. It has parameters where a loss learns something of its own: the
    temperature, or heads that only training has.
    """

    def __init__(
        self, weights: LossWeights, config: PVDAConfig, channels: int, stride: int, locations: int
    ) -> None:
        """`channels` and `stride` are those of the backbone's maps."""
        super().__init__()
        self.weights, self.log_scale = weights, None
        if weights.learn_temperature:
            self.log_scale = nn.Parameter(torch.tensor(-math.log(weights.temperature)))
        if weights.alignment_weight:
            self.alignment = AlignmentMaps(channels)
        if weights.gates_weight:
            self.gates = GateHeads(config, channels, locations)
        if weights.regions_weight:
            self.regions = RegionContrast(channels, config.image_size // stride)

    @property
    def learns(self) -> bool:
        """Whether it has parameters: it is then trained, wrapped and stored like the networks."""
        return any(True for _ in self.parameters())

    def forward(
        self, drone: ViewOutput, location1_B: Tensor, satellite: ViewOutput, location2_B: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted sum, and each loss without its weight; the location loss by view and part
        too.
        """
        weights = self.weights
        located_VP = location_terms(
            drone.logits_BPL, location1_B, satellite.logits_BPL, location2_B
        )
        divisor = located_VP.shape[1] if weights.location_mean else 1
        losses = {"location": located_VP.sum() / divisor}
        if weights.contrastive_weight:
            losses["contrastive"] = info_nce(
                unit_embedding(drone.g_BPD.float()),
                unit_embedding(satellite.g_BPD.float()),
                location1_B,
                weights.temperature if self.log_scale is None else (-self.log_scale).exp(),
                weights.label_smoothing,
            )
        if weights.triplet_weight:
            losses["triplet"] = cross_view_triplet(
                drone.dropped_BPD,
                location1_B,
                satellite.dropped_BPD,
                location2_B,
                weights.triplet_margin,
            )
        if weights.similarity_weight:
            losses["similarity"] = multi_similarity(
                torch.cat([drone.dropped_BPD[:, -1], satellite.dropped_BPD[:, -1]]),
                torch.cat([location1_B, location2_B]),
            )
        if weights.kl_weight:
            losses["kl"] = view_kl(drone.logits_BPL, satellite.logits_BPL)
        if weights.js_weight:
            losses["js"] = view_js(drone.logits_BPL, satellite.logits_BPL)
        if weights.alignment_weight:
            losses["alignment"] = dense_alignment(
                self.alignment(drone.maps_BCHW), self.alignment(satellite.maps_BCHW)
            )
        if weights.gates_weight:
            losses["gates"] = self.gates(drone.maps_BCHW, location1_B) + self.gates(
                satellite.maps_BCHW, location2_B
            )
        if weights.regions_weight:
            losses["regions"] = self.regions(drone.maps_BCHW, satellite.maps_BCHW, location1_B)
        total = sum(
            (getattr(weights, f"{name}_weight") * loss for name, loss in losses.items()),
            start=torch.zeros((), device=located_VP.device),
        )
        measures = {f"{name}_loss": loss for name, loss in losses.items()}
        return total, measures | by_view("location_loss", located_VP)


def by_view(name: str, terms: Tensor) -> dict[str, Tensor]:
    """The terms of a metric by view (V,), and by part where it has any (V, P)."""
    if terms.dim() == 1:
        return {f"{name}/{view}": term for view, term in zip(VIEWS, terms.unbind(), strict=True)}
    parts = {
        f"{name}/{view}/ring{ring}": term
        for view, terms_P in zip(VIEWS, terms.unbind(), strict=True)
        for ring, term in enumerate(terms_P.unbind(), start=1)
    }
    return by_view(name, terms.sum(1)) | parts
