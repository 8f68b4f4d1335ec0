"""TODO pipeline.core.arrays."""

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
Halves = npt.NDArray[np.float16]
Strings = npt.NDArray[np.str_]

Ints = npt.NDArray[np.int64]
Doubles = npt.NDArray[np.float64]

Mask = npt.NDArray[np.bool_]
