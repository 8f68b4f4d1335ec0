"""Contrastive losses over pairs: row i of both views shows one location.

Shapes: B pairs, E numbers of an embedding.
"""

import torch
from torch import Tensor


def info_nce(
    drone_BE: Tensor,
    satellite_BE: Tensor,
    location_B: Tensor,
    temperature: float | Tensor,
    label_smoothing: float,
) -> Tensor:
    """Symmetric InfoNCE: the mean of the cross-entropies of picking a row's partner among all rows
    of the other view, from the UAV and from the satellite [Sample4Geo; van den Oord et al., 2018].

    Embeddings have length 1, logits are their cosines divided by `temperature`. Other rows of the
    same location are no negatives: they are left out.
    """
    logits_BB = drone_BE.float() @ satellite_BE.float().T / temperature
    partner_BB = torch.eye(len(location_B), dtype=torch.bool, device=location_B.device)
    compared_BB = partner_BB | (location_B[:, None] != location_B[None, :])
    return (
        _pick_partner(logits_BB, compared_BB, label_smoothing)
        + _pick_partner(logits_BB.T, compared_BB.T, label_smoothing)
    ) / 2


def _pick_partner(logits_BB: Tensor, compared_BB: Tensor, label_smoothing: float) -> Tensor:
    """Mean cross-entropy of the diagonal among the compared columns; `label_smoothing` of the
    target is spread evenly over these."""
    log_p_BB = logits_BB.masked_fill(~compared_BB, -torch.inf).log_softmax(1)
    even_B = torch.where(compared_BB, log_p_BB, 0.0).sum(1) / compared_BB.sum(1)
    return -((1 - label_smoothing) * log_p_BB.diagonal() + label_smoothing * even_B).mean()
