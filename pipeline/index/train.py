"""What an index learns before it holds anything: a sample of the table in, an empty trained FAISS
index out.

Shapes: S rows of the sample, D dimensions.
"""

import math
from collections.abc import Iterator
from typing import Any

import faiss
import numpy as np

from pipeline.core.arrays import Ints
from pipeline.core.errors import InputError
from pipeline.features.table import FeatureTable, Floats

FAISS: Any = faiss  # whose types know nothing of its keyword arguments
SPECTRUM_ROWS = 16_384
"Rows by which the table's directions are weighed."
SAMPLE_BLOCK = 4_096
ENERGY = 0.999
"Of the vectors' squared length, what a projection has to keep."
PROJECTION_STEP = 32
"Projections have a multiple of so many directions."


def sample_rows(
    table: FeatureTable, rows_of_part: dict[str, int], rows: int
) -> tuple[Ints, Floats]:
    """About `rows` row numbers (S,) with their vectors (S, D), of each part its share: the first
    ones, as parts are ordered by hash. `rows_of_part`: of the table, in its order."""
    share = min(1.0, rows / max(1, sum(rows_of_part.values())))
    numbers_S = np.empty(min(rows, sum(rows_of_part.values())), np.int64)
    vectors_SD = np.empty((len(numbers_S), table.dimension), np.float32)
    begin = taken = 0
    for part, held in rows_of_part.items():
        wanted = min(len(numbers_S) - taken, math.ceil(held * share))
        if wanted:
            numbers_S[taken : taken + wanted] = np.arange(begin, begin + wanted)
            _fill(
                vectors_SD[taken : taken + wanted],
                table.only([part]).blocks(min(wanted, SAMPLE_BLOCK)),
            )
        begin, taken = begin + held, taken + wanted
    return numbers_S[:taken], vectors_SD[:taken]


def _fill(vectors_SD: Floats, blocks: Iterator[Floats]) -> None:
    """The first rows of the blocks."""
    at = 0
    for block_BD in blocks:
        here = min(len(block_BD), len(vectors_SD) - at)
        vectors_SD[at : at + here] = block_BD[:here]
        at += here
        if at == len(vectors_SD):
            return


def effective_dimension(sample_SD: Floats) -> int:
    """Leading directions that hold ENERGY of the squared length, rounded up to a multiple of STEP."""
    energy_D = np.maximum(_principal_directions(sample_SD)[0], 0)
    count = 1 + int(np.searchsorted(np.cumsum(energy_D), ENERGY * energy_D.sum()))
    return min(int(sample_SD.shape[1]), math.ceil(count / PROJECTION_STEP) * PROJECTION_STEP)


def new_index(factory: str, dimension: int) -> Any:
    """An empty FAISS index of the inner product, not trained yet.

    Raises InputError where FAISS cannot build it.
    """
    try:
        return FAISS.index_factory(dimension, factory, FAISS.METRIC_INNER_PRODUCT)
    except RuntimeError:
        raise InputError(
            f"--factory is {factory!r}, which FAISS cannot build over {dimension} dimensions; expected a factory string "
            "such as Flat or IVF1024,PQ64"
        ) from None


def train_index(index: Any, factory: str, sample_SD: Floats) -> None:
    """Train a new index on a sample.

    Raises InputError where FAISS cannot, as from too few rows.
    """
    if isinstance(FAISS.downcast_index(index), FAISS.IndexPreTransform):
        first = FAISS.downcast_VectorTransform(FAISS.downcast_index(index).chain.at(0))
        if isinstance(first, FAISS.PCAMatrix):
            _set_projection(first, sample_SD)
    try:
        index.train(sample_SD)
    except RuntimeError as error:
        reason = str(error).rsplit("Error: ", 1)[-1].splitlines()[0]
        raise InputError(
            f"--factory is {factory!r}, which FAISS cannot train on {len(sample_SD)} rows ({reason}); expected more rows, or a "
            "factory string with fewer lists or smaller codes"
        ) from None


def _principal_directions(sample_SD: Floats) -> tuple[Floats, Floats]:
    """Energy (D,) of the directions and the directions (D, D) as rows, the strongest first.

    Of the second moments, not the covariance: FAISS's own PCA takes the mean away, which changes
    inner products.
    """
    moments_DD = (sample_SD.T @ sample_SD) / len(sample_SD)
    energy_D, axes_DD = np.linalg.eigh(moments_DD)
    return energy_D[::-1], axes_DD.T[::-1]


def _set_projection(transform: Any, sample_SD: Floats) -> None:
    kept = np.ascontiguousarray(_principal_directions(sample_SD)[1][: transform.d_out], np.float32)
    FAISS.copy_array_to_vector(kept.ravel(), transform.A)
    FAISS.copy_array_to_vector(np.zeros(transform.d_out, np.float32), transform.b)
    transform.have_bias, transform.is_trained = False, True
    transform.is_orthonormal = True
