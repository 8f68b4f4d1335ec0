"""Imports features that another program saved as a `.mat` file, for our evaluation to measure.

In: the file that University-1652's test.py and its descendants write (gallery_f, gallery_label,
query_f, query_label, and gallery_path, query_path where they are kept). Out: a feature table of the
queries and one of the gallery.
Shapes: N images, D dimensions.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.core import storage
from pipeline.core.arrays import Floats
from pipeline.core.errors import InputError
from pipeline.core.lock import locks_output
from pipeline.core.records import Split, View, make_key
from pipeline.features.mat_file import REQUIRED, IsHdf5, Unreadable, read_mat
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.features.settings import ImportSettings

PART_ROWS = 8_192
JUNK_LABEL = "-1"
"The official evaluation takes gallery rows of this label out of the ranking."


@dataclass(frozen=True, kw_only=True)
class _EmbeddingSet:
    features_ND: Floats
    labels: list[str]
    "Whole numbers, or names, as text."
    paths: list[list[str]]
    "Split at the slashes; empty where the file has none."


@locks_output(lambda settings: settings.out)
def import_features(settings: ImportSettings) -> dict[str, tuple[str, int]]:
    """Write OUT/queries and OUT/gallery; returns, for each, its path and rows.

    A location is the name of the image's folder where the file gives paths for both sets, else the
    label: a whole number as text, or a name. Vectors are brought to unit length. Raises InputError
    when the file is invalid, or OUT holds other features.
    """
    if not storage.is_file(settings.mat):
        raise InputError(
            f"no file at {settings.mat}; expected a .mat file of features; check the path"
        )
    data = storage.read_bytes(settings.mat)
    arrays = _load(settings.mat, data)
    sets = {name: _embedding_set(settings.mat, arrays, name) for name in ("query", "gallery")}
    kinds = {name: arrays[f"{name}_label"].dtype.kind == "U" for name in sets}
    if len(set(kinds.values())) > 1:
        text, numbers = ("query", "gallery") if kinds["query"] else ("gallery", "query")
        raise InputError(
            f"{settings.mat} has {text}_label that are text and {numbers}_label that are numbers; "
            "expected the same kind, since equal labels mean the same location; save both alike"
        )
    widths = {name: one.features_ND.shape[1] for name, one in sets.items()}
    if len(set(widths.values())) > 1:
        raise InputError(
            f"{settings.mat} has queries of {widths['query']} and a gallery of {widths['gallery']} "
            "dimensions; expected one network's features; save both with the same one"
        )
    by_path = all(
        len(one.paths) == len(one.labels) and all(len(parts) > 1 for parts in one.paths)
        for one in sets.values()
    )
    fingerprint = hashlib.sha256(data).hexdigest()
    written = {}
    for name, folder, split, view in (
        ("query", "queries", Split.QUERY, settings.query_view),
        ("gallery", "gallery", Split.GALLERY, settings.gallery_view),
    ):
        table = storage.join(settings.out, folder)
        rows = _write_table(table, sets[name], split, View(view), fingerprint, by_path)
        written[name] = (table, rows)
    return written


def _load(path: str, data: bytes) -> dict[str, Any]:
    try:
        arrays, names = read_mat(data)
    except IsHdf5:
        raise InputError(
            f"{path} is a MATLAB 7.3 file (HDF5); expected MATLAB 5; save it again with "
            "scipy.io.savemat, or with -v7 in MATLAB"
        ) from None
    except Unreadable as error:
        raise InputError(
            f"{path} cannot be read as a .mat file ({error}); expected one that scipy.io.savemat "
            "wrote"
        ) from None
    missing = [name for name in REQUIRED if name not in arrays]
    if missing:
        raise InputError(
            f"{path} holds {', '.join(names)[:300] or 'nothing'}; expected {', '.join(missing)} "
            "too, as University-1652's test.py saves them; save them under these names"
        )
    return arrays


def _embedding_set(path: str, arrays: dict[str, Any], name: str) -> _EmbeddingSet:
    """The queries or the gallery of a file, without junk. Raises InputError."""
    with np.errstate(over="ignore"):  # an infinite length is refused below
        features_ND = np.asarray(arrays[f"{name}_f"], np.float32)
    labels = _labels(path, name, np.ravel(arrays[f"{name}_label"]))
    paths: list[str] = arrays.get(f"{name}_path", np.array([], np.str_)).tolist()
    if (
        features_ND.ndim != 2
        or len(features_ND) != len(labels)
        or (paths and len(paths) != len(labels))
    ):
        raise InputError(
            f"{path} has {name}_f of shape {features_ND.shape}, {len(labels)} labels and "
            f"{len(paths)} paths; expected one row, one label and one path (or no paths at all) "
            "for each image; save them again"
        )
    if name == "gallery" and JUNK_LABEL in labels:
        kept = [row for row, label in enumerate(labels) if label != JUNK_LABEL]
        features_ND, labels = features_ND[kept], [labels[row] for row in kept]
        paths = [paths[row] for row in kept] if paths else []
    length_N1 = np.linalg.norm(features_ND.astype(np.float64), axis=1, keepdims=True)
    valid_N1 = np.isfinite(length_N1) & (length_N1 > 0)
    if not valid_N1.all():
        row = int(np.argmin(valid_N1))
        raise InputError(
            f"row {row} of {name}_f in {path} has length {length_N1[row, 0]:g}; expected vectors "
            "of finite length above 0; leave that image out"
        )
    return _EmbeddingSet(
        features_ND=(features_ND / length_N1).astype(np.float32),
        labels=labels,
        paths=[one.replace("\\", "/").split("/") for one in paths],
    )


def _labels(path: str, name: str, label_N: npt.NDArray[Any]) -> list[str]:
    """The labels as text. Raises InputError for numbers with a fraction and for empty names."""
    text = label_N.dtype.kind == "U"
    if text:
        invalid_N = label_N == ""
    else:
        with np.errstate(invalid="ignore"):  # infinity % 1
            invalid_N = ~np.isfinite(label_N) | (np.abs(label_N) >= 2**63) | (label_N % 1 != 0)
    if invalid_N.any():
        row = int(np.argmax(invalid_N))
        kind = "empty in places" if text else "no whole numbers"
        raise InputError(
            f"{path} has {name}_label that are {kind} (row {row} is {label_N[row].item()!r}); "
            "expected one whole number or one name per image; save them again"
        )
    return label_N.tolist() if text else [str(int(label)) for label in label_N]


def _write_table(
    table: str, embeddings: _EmbeddingSet, split: Split, view: View, fingerprint: str, by_path: bool
) -> int:
    """Write one table; returns its rows. Raises InputError where the folder has other files."""
    paths, labels = embeddings.paths, embeddings.labels
    if by_path and paths and len(paths[0]) > 2:  # .../query_drone/0001/image-01.jpeg
        view = next((one for one in View if str(one) in paths[0][-3]), view)
    locations = [parts[-2] for parts in paths] if by_path else labels
    stems = [parts[-1].rsplit(".", 1)[0] for parts in paths] or [""] * len(labels)
    keys = _keys(split, view, locations, stems)
    names = [
        f"{split}-{view}-{first // PART_ROWS:06d}.parquet"
        for first in range(0, len(keys), PART_ROWS)
    ]
    if others := sorted(set(storage.list_names(table)) - set(names)):
        raise InputError(
            f"{table} holds {others[0]}, which is not of these features; choose another --out"
        )
    for number, name in enumerate(names):
        rows = slice(number * PART_ROWS, (number + 1) * PART_ROWS)
        count = len(keys[rows])
        write_part(
            storage.join(table, name),
            PartRows(
                keys=keys[rows],
                locations=locations[rows],
                views=[view] * count,
                splits=[split] * count,
                lats=[None] * count,
                lons=[None] * count,
                embeddings_BD=embeddings.features_ND[rows],
            ),
            PartFooter(fingerprint=fingerprint, shard_sha256=f"{fingerprint}-{number}", rows=count),
        )
    return len(keys)


def _keys(split: Split, view: View, locations: Sequence[str], stems: Sequence[str]) -> list[str]:
    """A unique key per image. A file that our own exports named gets its old key back."""
    keys, seen = [], set[str]()
    for row, (location, stem) in enumerate(zip(locations, stems, strict=True)):
        exported = stem.startswith(make_key(split, view, location, ""))
        key = stem if exported else make_key(split, view, location, stem or f"{row:06d}")
        if key in seen:
            key = make_key(split, view, location, f"{stem}-{row:06d}")
        seen.add(key)
        keys.append(key)
    return keys
