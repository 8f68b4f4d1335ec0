"""Reading FAISS files, and FAISS's parameters of a search: what every module does with FAISS alike.

In: a file of an index, or an opened FAISS index of any kind that we build. Out: FAISS's objects.
"""

import shutil
from typing import Any

import faiss
import numpy as np

from pipeline.core import storage
from pipeline.core.arrays import Mask
from pipeline.core.errors import InputError
from pipeline.index.metadata import REBUILD_HINT
from pipeline.index.planning.plan import RERANK_FACTOR

FAISS: Any = faiss
"Without types: FAISS's stubs lack the keyword arguments."


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


def local_copy(path: str, folder: str) -> str:
    """A local path at which a file can be mapped: its own, or that of a copy in `folder`."""
    if storage.is_local(path):
        return str(storage.resolve(path)[1])
    target = storage.join(folder, path.rsplit("/", 1)[-1])
    with storage.open_read(path) as source, open(target, "wb") as copy:
        shutil.copyfileobj(source, copy, 1 << 24)
    return target
