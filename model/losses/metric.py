"""Metric losses over the embeddings of both views, by their location labels.

Shapes: B images of a view, N images in all, P parts, D numbers of a part.
"""

import torch
import torch.nn.functional as F
from torch import Tensor


def cross_view_triplet(
    drone_BPD: Tensor,
    location1_B: Tensor,
    satellite_BPD: Tensor,
    location2_B: Tensor,
    margin: float,
) -> Tensor:
    """Triplet loss with the hardest examples of the other view, the mean over parts and over the 2B
    anchors [FSRA, MCCG].

    Parts have length 1 and are compared by Euclidean distance; the positive is the farthest image
    of the anchor's location, the negative the nearest of another. An anchor whose location the
    other view lacks in this batch, or that fills all of it, counts as 0.
    """
    drone_PBD, satellite_PBD = _unit_parts(drone_BPD), _unit_parts(satellite_BPD)
    squares_PBB = (
        drone_PBD.square().sum(2)[:, :, None]
        + satellite_PBD.square().sum(2)[:, None, :]
        - 2 * drone_PBD @ satellite_PBD.transpose(1, 2)
    )
    distances_PBB = squares_PBB.clamp_min(1e-6).sqrt()
    same_BB = location1_B[:, None] == location2_B[None, :]
    each = [
        _hardest_hinge(distances_PBB, same_BB, margin),
        _hardest_hinge(distances_PBB.transpose(1, 2), same_BB.T, margin),
    ]
    return torch.cat(each, dim=1).mean()


def _unit_parts(g_BPD: Tensor) -> Tensor:
    """(P, B, D) in float32, of length 1 [FSRA: divided by the length + 1e-6]."""
    g_PBD = g_BPD.float().transpose(0, 1)
    lengths_PB1: Tensor = torch.linalg.vector_norm(g_PBD, dim=2, keepdim=True)
    return g_PBD / (lengths_PB1 + 1e-6)


def _hardest_hinge(distances_PAB: Tensor, same_AB: Tensor, margin: float) -> Tensor:
    """relu(farthest positive - nearest negative + margin) of each anchor, (P, A)."""
    farthest_PA = distances_PAB.masked_fill(~same_AB, -torch.inf).amax(2)
    nearest_PA = distances_PAB.masked_fill(same_AB, torch.inf).amin(2)
    hinge_PA = F.relu(farthest_PA - nearest_PA + margin)
    both_A = same_AB.any(1) & ~same_AB.all(1)
    return torch.where(both_A, hinge_PA, 0.0)


def multi_similarity(
    g_ND: Tensor,
    location_N: Tensor,
    *,
    epsilon: float = 0.4,
    base: float = 0.1,
    positive_scale: float = 5.0,
    negative_scale: float = 100.0,
) -> Tensor:
    """Multi-similarity loss over the cosines of all images of both views, with its miner (Wang,
    CVPR 2019; constants as in QDFL).

    Mined are negatives that come within `epsilon` of the anchor's worst positive, and positives
    within `epsilon` of its best negative.
    """
    unit_ND = F.normalize(g_ND.float(), dim=1)
    cosines_NN = unit_ND @ unit_ND.T
    same_NN = location_N[:, None] == location_N[None, :]
    positive_NN = same_NN & ~torch.eye(len(g_ND), dtype=torch.bool, device=g_ND.device)
    worst_N1 = cosines_NN.masked_fill(~positive_NN, torch.inf).amin(1, keepdim=True)
    best_N1 = cosines_NN.masked_fill(same_NN, -torch.inf).amax(1, keepdim=True)
    hard_negative_NN = ~same_NN & (cosines_NN + epsilon > worst_N1)
    hard_positive_NN = positive_NN & (cosines_NN - epsilon < best_N1)
    pull_N = _soft_sum(-positive_scale * (cosines_NN - base), hard_positive_NN) / positive_scale
    push_N = _soft_sum(negative_scale * (cosines_NN - base), hard_negative_NN) / negative_scale
    return (pull_N + push_N).mean()


def _soft_sum(exponents_NN: Tensor, chosen_NN: Tensor) -> Tensor:
    """ln(1 + sum of e^exponent over the chosen), (N,)."""
    kept_NN = exponents_NN.masked_fill(~chosen_NN, -torch.inf)
    return torch.cat([kept_NN, kept_NN.new_zeros(len(kept_NN), 1)], dim=1).logsumexp(1)
