"""Necks: a part's vector -> the numbers that are compared, and that the location classifier sees.

In: (B, C). Out: (B, D). `linear` is the first half of LPN's classifier block: its second Linear is
`LocationClassifier`. Shapes: B images, C numbers of a part, D numbers of its embedding.
"""

from torch import nn

from model.config import Neck


def build_neck(kind: Neck, channels: int, part_dim: int) -> nn.Sequential | nn.LayerNorm:
    """A neck, initialised as published. Raises ValueError where it cannot change C to D."""
    if kind == "norm":
        if part_dim != channels:
            raise ValueError(
                f"part_dim is {part_dim}, expected {channels}: neck norm keeps the backbone's "
                f"channels; set --part-dim {channels}, or --neck linear"
            )
        return nn.LayerNorm(channels, eps=1e-6)
    linear, norm = nn.Linear(channels, part_dim), nn.BatchNorm1d(part_dim)
    nn.init.kaiming_normal_(linear.weight, mode="fan_out")
    nn.init.zeros_(linear.bias)
    if kind == "linear":  # `linear_ones` keeps torch's ones
        nn.init.normal_(norm.weight, 1.0, 0.02)
    return nn.Sequential(linear, norm)
