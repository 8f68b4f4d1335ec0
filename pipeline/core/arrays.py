"""Type aliases of NumPy arrays, by the type of their elements, and evenly spaced samples. Shapes
are in the names of variables."""

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]
Halves = npt.NDArray[np.float16]
Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]
Strings = npt.NDArray[np.str_]
Pixels = npt.NDArray[np.uint8]


def evenly_spaced(count: int, most: int) -> Ints:
    """Numbers of at most `most` of `count` items, ascending, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))
