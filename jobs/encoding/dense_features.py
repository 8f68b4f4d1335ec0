"""Dense features of the built-in encoder, as matching asks for them.

In: an image, a grid and a mask. Out: the points of the grid with their descriptors.
"""

from functools import cached_property

import numpy as np
import torch

from model.dense import DenseEncoder, load_dense, sample
from pipeline.core.arrays import Doubles, Pixels
from pipeline.matching.local_features import LocalFeatures


class BuiltinDenseFinder:
    """A `DenseFinder`; the network is read when it is first called."""

    @cached_property
    def _encoder(self) -> DenseEncoder:
        return load_dense()

    @torch.inference_mode()
    def __call__(self, image_HW3: Pixels, step_px: int, mask_HW: Pixels) -> LocalFeatures:
        """Of a point in each square of `step_px` pixels, where `mask_HW` is not 0."""
        points_N2 = grid_points(image_HW3.shape[1], image_HW3.shape[0], step_px)
        points_N2 = points_N2[mask_HW[tuple(points_N2.T[::-1].astype(int))] > 0]
        described_ND = sample(self._encoder.describe(image_HW3), torch.from_numpy(points_N2))
        return LocalFeatures(points_N2=points_N2, descriptors_ND=described_ND.numpy())


def grid_points(width: int, height: int, step_px: int) -> Doubles:
    """The middles (N, 2), column and row, of an image's squares of `step_px` pixels."""
    rows, columns = np.mgrid[step_px / 2 : height : step_px, step_px / 2 : width : step_px]
    return np.stack([columns.ravel(), rows.ravel()], axis=1)
