"""Fusing BatchNorm into the layer before it: in evaluation it is a scale and a shift.

In: an encoder in evaluation mode. Out: a copy that computes the same with fewer passes over memory.
"""

import copy
from itertools import pairwise

from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval, fuse_linear_bn_eval

from model.pvda import FeatureEncoder


def fuse_batchnorm(encoder: FeatureEncoder) -> FeatureEncoder:
    """A copy of `encoder` whose BatchNorms are folded into convolutions and linear layers, without
    gradients. One that follows neither, as USAM's, stays.

    Its embeddings differ from the encoder's by float32's rounding only. `encoder` itself is
    unchanged.

    Raises ValueError when the encoder is in training mode.
    """
    if any(
        isinstance(module, nn.modules.batchnorm._BatchNorm) and module.training
        for module in encoder.modules()
    ):
        raise ValueError(
            "the encoder is in training mode, where BatchNorm depends on the batch; expected "
            "evaluation mode; call eval()"
        )
    folded = copy.deepcopy(encoder).requires_grad_(False)
    for parent in list(folded.modules()):
        _fuse_children(parent)
    return folded


def _fuse_children(parent: nn.Module) -> None:
    """Fold each BatchNorm into the child registered just before it: in our networks that is the
    layer it normalises.
    """
    children = list(parent.named_children())
    for (name, layer), (norm_name, norm) in pairwise(children):
        if isinstance(layer, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
            setattr(parent, name, fuse_conv_bn_eval(layer, norm))
        elif isinstance(layer, nn.Linear) and isinstance(norm, nn.BatchNorm1d):
            setattr(parent, name, fuse_linear_bn_eval(layer, norm))
        else:
            continue
        setattr(parent, norm_name, nn.Identity())
