"""Reading FAISS files, and FAISS's parameters of a search: what every module does with FAISS alike.

In: a file of an index, or an opened FAISS index of any kind that we build. Out: FAISS's objects.
Shapes: Q queries, K wanted rows, D dimensions, N rows, or lists of a query.
"""

import shutil
from typing import Any

import faiss
import numpy as np

from pipeline.core import storage
from pipeline.core.arrays import Floats, Ints, Mask
from pipeline.core.errors import InputError
from pipeline.index.metadata import REBUILD_HINT, SearchParams
from pipeline.index.planning.plan import RERANK_FACTOR

FAISS: Any = faiss
"Without types: FAISS's stubs lack the keyword arguments."
NO_LIST = -1
"FAISS's number for a list that is not searched."


def read_faiss(path: str, on_disk: bool) -> Any:
    """A FAISS index from a local file; `on_disk`: its lists are mapped, not read.

    Raises InputError where FAISS cannot read it.
    """
    try:
        return FAISS.read_index(path, FAISS.IO_FLAG_MMAP if on_disk else 0)
    except RuntimeError as error:
        raise InputError(f"{path} is damaged ({faiss_reason(error)}); {REBUILD_HINT}") from None


def faiss_reason(error: RuntimeError) -> str:
    """The sentence in an error of FAISS, whose messages begin with a position in its source."""
    return str(error).rsplit("Error: ", 1)[-1].splitlines()[0]


def faiss_parameters(index: Any, nprobe_or_ef: int, allowed_N: Mask | None) -> Any:
    """FAISS's search parameters for any index that we build, with a mask of the allowed rows."""
    # A name of its own: `index` must outlive the view that downcasting returns.
    kind = FAISS.downcast_index(index)
    if isinstance(kind, FAISS.IndexPreTransform):
        inner = faiss_parameters(kind.index, nprobe_or_ef, allowed_N)
        return FAISS.SearchParametersPreTransform(index_params=inner)
    if isinstance(kind, FAISS.IndexRefine):
        inner = faiss_parameters(kind.base_index, nprobe_or_ef, allowed_N)
        return FAISS.IndexRefineSearchParameters(k_factor=RERANK_FACTOR, base_index_params=inner)
    selector: dict[str, Any] = {}
    if allowed_N is not None:
        selector["sel"] = FAISS.IDSelectorBitmap(np.packbits(allowed_N, bitorder="little"))
    if isinstance(kind, FAISS.IndexIVF):
        return FAISS.SearchParametersIVF(nprobe=min(nprobe_or_ef, kind.nlist), **selector)
    if isinstance(kind, FAISS.IndexHNSW):
        return FAISS.SearchParametersHNSW(efSearch=nprobe_or_ef, **selector)
    return FAISS.SearchParameters(**selector)


def search_faiss(
    index: Any,
    queries_QD: Floats,
    k: int,
    least: int,
    params: SearchParams,
    allowed_N: Mask | None = None,
) -> tuple[Floats, Ints]:
    """Scores and row numbers (Q, K) of FAISS's search in any index that we build.

    With `params.list_ratio` a query's lists are skipped whose centres score below that share of
    its best centre's: an easy query looks into one, a hard one into all nprobe. Queries that find
    fewer than `least` rows so are searched again. A filter leaves few rows in each list, and skips
    none.
    """
    parameters = faiss_parameters(index, params.nprobe_or_ef, allowed_N)
    if not params.list_ratio or allowed_N is not None or not _can_skip_lists(index):
        found: tuple[Floats, Ints] = index.search(queries_QD, k, params=parameters)
        return found
    scores_QK, rows_QK = _search_near_lists(index, queries_QD, k, params)
    short_Q = np.count_nonzero(rows_QK >= 0, axis=1) < least
    if short_Q.any():
        scores_QK[short_Q], rows_QK[short_Q] = index.search(
            queries_QD[short_Q], k, params=parameters
        )
    return scores_QK, rows_QK


def _can_skip_lists(index: Any) -> bool:
    """Whether an index has lists whose search is faster where some are skipped: packed codes are
    searched by many queries at once, which skipping ends (twice the time, measured).
    """
    kind = FAISS.downcast_index(index)
    if isinstance(kind, FAISS.IndexPreTransform):
        kind = FAISS.downcast_index(kind.index)
    return isinstance(kind, FAISS.IndexIVF) and not isinstance(kind, FAISS.IndexIVFFastScan)


def _search_near_lists(
    index: Any, queries_QD: Floats, k: int, params: SearchParams
) -> tuple[Floats, Ints]:
    """Search only lists whose centres score near each query's best centre."""
    kind = FAISS.downcast_index(index)
    if isinstance(kind, FAISS.IndexPreTransform):
        for number in range(kind.chain.size()):
            queries_QD = FAISS.downcast_VectorTransform(kind.chain.at(number)).apply(queries_QD)
        kind = FAISS.downcast_index(kind.index)
    nprobe = min(params.nprobe_or_ef, kind.nlist)
    centre_QN, list_QN = kind.quantizer.search(queries_QD, nprobe)
    near_QN = centre_QN >= params.list_ratio * centre_QN[:, :1]
    near_QN[:, 0] = True  # also where the best centre's score is negative
    kind.nprobe = int(near_QN.sum(axis=1).max())  # centres come in the order of their scores
    list_QN = np.where(near_QN, list_QN, NO_LIST)[:, : kind.nprobe]
    scores_QK, rows_QK = kind.search_preassigned(
        queries_QD, k, list_QN, centre_QN[:, : kind.nprobe]
    )
    return scores_QK, rows_QK


def local_copy(path: str, folder: str) -> str:
    """A local path at which a file can be mapped: its own, or that of a copy in `folder`."""
    if storage.is_local(path):
        return str(storage.resolve(path)[1])
    target = storage.join(folder, path.rsplit("/", 1)[-1])
    with storage.open_read(path) as source, open(target, "wb") as copy:
        shutil.copyfileobj(source, copy, 1 << 24)
    return target
