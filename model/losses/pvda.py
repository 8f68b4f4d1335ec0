"""The paper's losses, one function per equation; 1 is the UAV's view, 2 the satellite's.

All reduce by the mean over the images of a view, then sum over views and rings [LPN]: literal sums
over the data set, as printed, would weigh 54 UAV images against one satellite image. Each equation
is the sum of its terms, one per view (and ring), which training reports one by one. Shapes: B
images, V views, P rings, L locations.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

DRONE, SATELLITE = 0, 1
"The view labels that the discriminator learns."


def location_loss(
    logits1_BPL: Tensor, location1_B: Tensor, logits2_BPL: Tensor, location2_B: Tensor
) -> Tensor:
    """Eq. 1, L_L: cross-entropy of the locations, summed over rings and views."""
    return location_terms(logits1_BPL, location1_B, logits2_BPL, location2_B).sum()


def location_terms(
    logits1_BPL: Tensor, location1_B: Tensor, logits2_BPL: Tensor, location2_B: Tensor
) -> Tensor:
    """The terms of Eq. 1 (V, P): cross-entropy by view and ring, mean over the view's images."""
    return torch.stack(
        [location_by_part(logits1_BPL, location1_B), location_by_part(logits2_BPL, location2_B)]
    )


def view_loss(verdict1_B2: Tensor, verdict2_B2: Tensor) -> Tensor:
    """Eq. 2, L_V: cross-entropy of the true views; trains the discriminator."""
    return view_terms(verdict1_B2, verdict2_B2).sum()


def view_terms(verdict1_B2: Tensor, verdict2_B2: Tensor) -> Tensor:
    """The terms of Eq. 2 (V,)."""
    return torch.stack([_views(verdict1_B2, DRONE), _views(verdict2_B2, SATELLITE)])


def adversarial_loss(verdict1_B2: Tensor, verdict2_B2: Tensor) -> Tensor:
    """Eq. 3, L_A: cross-entropy of the swapped views; trains the encoder to be mistaken for the
    other view.
    """
    return adversarial_terms(verdict1_B2, verdict2_B2).sum()


def adversarial_terms(verdict1_B2: Tensor, verdict2_B2: Tensor) -> Tensor:
    """The terms of Eq. 3 (V,)."""
    return torch.stack([_views(verdict1_B2, SATELLITE), _views(verdict2_B2, DRONE)])


def feature_loss(location: Tensor, adversarial: Tensor, alpha: float) -> Tensor:
    """Eq. 4, L_FL = L_L + alpha * L_A."""
    return location + alpha * adversarial


def location_by_part(logits_BPL: Tensor, location_B: Tensor) -> Tensor:
    """Cross-entropy of one view's locations by part, the mean over its images (P,)."""
    # In float32 whatever precision the networks computed in: a softmax over many locations needs
    # all of its bits.
    parts = logits_BPL.shape[1]
    each_BP = F.cross_entropy(
        logits_BPL.float().flatten(0, 1), location_B.repeat_interleave(parts), reduction="none"
    )
    return each_BP.view(-1, parts).mean(0)


def _views(verdict_B2: Tensor, label: int) -> Tensor:
    return F.cross_entropy(
        verdict_B2.float(), torch.full((len(verdict_B2),), label, device=verdict_B2.device)
    )
