"""Type aliases of NumPy arrays, by the type of their elements. Shapes are in the names of
variables."""

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]
Halves = npt.NDArray[np.float16]
Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]
Strings = npt.NDArray[np.str_]
Pixels = npt.NDArray[np.uint8]
