"""Agreement of the two views of a pair: of their location logits, and of their feature maps.

Row i of both views shows one location. Shapes: B pairs, P parts, L locations, K channels and N
cells of weighted maps.
"""

import torch.nn.functional as F
from torch import Tensor


def view_kl(drone_BPL: Tensor, satellite_BPL: Tensor) -> Tensor:
    """KL(UAV || satellite) of the location probabilities, the mean over pairs and parts; gradients
    reach both [FSRA's option].
    """
    return _divergence(drone_BPL.float().log_softmax(2), satellite_BPL.float().log_softmax(2))


def view_js(drone_BPL: Tensor, satellite_BPL: Tensor) -> Tensor:
    """Half of KL(M || UAV) + KL(M || satellite), M the mean of both probabilities as a constant:
    like the Jensen-Shannon divergence, with its terms turned [QDFL].
    """
    logs = [logits_BPL.float().log_softmax(2) for logits_BPL in (drone_BPL, satellite_BPL)]
    mean_BPL = ((logs[0].exp() + logs[1].exp()) / 2).detach()
    log_mean_BPL = mean_BPL.clamp_min(1e-30).log()
    drone, satellite = (_divergence(log_mean_BPL, log_BPL) for log_BPL in logs)
    return (drone + satellite) / 2


def _divergence(log_p_BPL: Tensor, log_q_BPL: Tensor) -> Tensor:
    """KL(p || q), the mean over pairs and parts."""
    each = F.kl_div(log_q_BPL, log_p_BPL, reduction="none", log_target=True)
    return each.sum(2).mean()


def dense_alignment(drone_BKN: Tensor, satellite_BKN: Tensor) -> Tensor:
    """1 - cosine of the two views' weighted maps, each taken as one vector; the mean over pairs
    [DAC].
    """
    cosine_B = F.cosine_similarity(drone_BKN.float().flatten(1), satellite_BKN.float().flatten(1))
    return 1 - cosine_B.mean()
