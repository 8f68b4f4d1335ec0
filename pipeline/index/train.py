"""Trains a FAISS index before it holds any row: a sample of the table in, an empty index out.

Shapes: S rows of the sample, D dimensions.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from pipeline.core.arrays import Floats, Ints
from pipeline.core.errors import InputError
from pipeline.features.table import FeatureTable
from pipeline.index.faiss_io import FAISS, faiss_reason

SPECTRUM_ROWS = 16_384
"Rows from which the energy of the table's directions is computed."
SAMPLE_BLOCK = 4_096
ENERGY = 0.999
"Share of the vectors' squared length that a projection has to keep."
PROJECTION_STEP = 32
"Projections have a multiple of so many directions."


def sample_rows(
    table: FeatureTable, rows_of_part: dict[str, int], rows: int
) -> tuple[Ints, Floats]:
    """About `rows` row numbers (S,) with their vectors (S, D), of each part its share.

    A part's share are its first rows, for parts are ordered by hash. `rows_of_part`: of the table,
    in its order.
    """
    total = sum(rows_of_part.values())
    share = min(1.0, rows / max(1, total))
    row_S = np.empty(min(rows, total), np.int64)
    vectors_SD = np.empty((len(row_S), table.dimension), np.float32)
    first = taken = 0
    for part, count in rows_of_part.items():
        wanted = min(len(row_S) - taken, math.ceil(count * share))
        if wanted:
            end = taken + wanted
            row_S[taken:end] = np.arange(first, first + wanted)
            blocks = table.with_parts([part]).blocks(min(wanted, SAMPLE_BLOCK))
            _fill(vectors_SD[taken:end], blocks)
        first, taken = first + count, taken + wanted
    return row_S[:taken], vectors_SD[:taken]


def _fill(vectors_SD: Floats, blocks: Iterator[Floats]) -> None:
    """Copy the first rows of the blocks."""
    filled = 0
    for block_BD in blocks:
        count = min(len(block_BD), len(vectors_SD) - filled)
        vectors_SD[filled : filled + count] = block_BD[:count]
        filled += count
        if filled == len(vectors_SD):
            return


def effective_dimension(sample_SD: Floats) -> int:
    """Leading directions that hold ENERGY of the squared length, rounded up to a multiple of
    PROJECTION_STEP.
    """
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
            f"--factory is {factory!r}, which FAISS cannot build over {dimension} dimensions; "
            "expected a factory string such as Flat or IVF1024,PQ64"
        ) from None


def train_index(index: Any, factory: str, sample_SD: Floats) -> None:
    """Train a new index on a sample.

    Raises InputError where FAISS cannot, such as from too few rows.
    """
    if isinstance(FAISS.downcast_index(index), FAISS.IndexPreTransform):
        first = FAISS.downcast_VectorTransform(FAISS.downcast_index(index).chain.at(0))
        if isinstance(first, FAISS.PCAMatrix):
            _set_projection(first, sample_SD)
    try:
        index.train(sample_SD)
    except RuntimeError as error:
        raise InputError(
            f"--factory is {factory!r}, which FAISS cannot train on {len(sample_SD)} rows "
            f"({faiss_reason(error)}); expected more rows, or a factory string with fewer lists or "
            "smaller codes"
        ) from None


def _principal_directions(sample_SD: Floats) -> tuple[Floats, Floats]:
    """Energy (D,) of the directions and the directions (D, D) as rows, the strongest first.

    Of the second moments, not the covariance: FAISS's own PCA subtracts the mean, which changes
    inner products.
    """
    moments_DD = (sample_SD.T @ sample_SD) / len(sample_SD)
    energy_D, axes_DD = np.linalg.eigh(moments_DD)
    return energy_D[::-1], axes_DD.T[::-1]


def _set_projection(transform: Any, sample_SD: Floats) -> None:
    directions_DD = _principal_directions(sample_SD)[1]
    kept = np.ascontiguousarray(directions_DD[: transform.d_out], np.float32)
    FAISS.copy_array_to_vector(kept.ravel(), transform.A)
    FAISS.copy_array_to_vector(np.zeros(transform.d_out, np.float32), transform.b)
    transform.have_bias, transform.is_trained = False, True
    transform.is_orthonormal = True
