"""Features that another program saved as a `.mat` file -> feature tables, so that our evaluation
can judge them.

In: the file that University-1652's test.py and its descendants write (gallery_f, gallery_label,
query_f, query_label, and gallery_path, query_path where they are kept). Out: a table of the queries
and one of the gallery.
"""

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.lock import locks_output
from pipeline.core.records import Split, View, make_key
from pipeline.features.mat_file import NUMBERS, IsHdf5, Unreadable, read_mat
from pipeline.features.settings import ImportSettings
from pipeline.features.table import Floats, PartFooter, PartRows, write_part

PART_ROWS = 8_192
JUNK_LABEL = -1  # the official evaluation takes gallery rows of this label out of the ranking


@dataclass(frozen=True, kw_only=True)
class _EmbeddingSet:
    features_ND: Floats
    labels: list[int]
    paths: list[str]
    "Empty where the file has none."


@locks_output(lambda settings: settings.out)
def import_features(settings: ImportSettings) -> dict[str, tuple[str, int]]:
    """Write OUT/queries and OUT/gallery; returns, for each, its path and rows. What is there
    already is left as it is.

    A location is the name of the image's folder where the file gives paths for both sides, else the
    label as text. Vectors are brought to unit length. Raises InputError when the file is not what
    it should be, or OUT holds other features.
    """
    if not storage.is_file(settings.mat):
        raise InputError(
            f"no file at {settings.mat}; expected a .mat file of features; check the path"
        )
    data = storage.read_bytes(settings.mat)
    said = _load(settings.mat, data)
    sides = {name: _side(settings.mat, said, name) for name in ("query", "gallery")}
    widths = {name: side.features_ND.shape[1] for name, side in sides.items()}
    if len(set(widths.values())) > 1:
        raise InputError(
            f"{settings.mat} has queries of {widths['query']} and a gallery of {widths['gallery']} dimensions; expected one "
            "network's features; save both with the same one"
        )
    by_path = all(
        len(side.paths) == len(side.labels)
        and all("/" in path.replace("\\", "/") for path in side.paths)
        for side in sides.values()
    )
    fingerprint = hashlib.sha256(data).hexdigest()
    written = {}
    for name, split, view in (
        ("query", Split.QUERY, settings.query_view),
        ("gallery", Split.GALLERY, settings.gallery_view),
    ):
        table = storage.join(settings.out, "queries" if name == "query" else "gallery")
        written[name] = (table, _write(table, sides[name], split, View(view), fingerprint, by_path))
    return written


def _load(path: str, data: bytes) -> dict[str, Any]:
    try:
        said, held = read_mat(data)
    except IsHdf5:
        raise InputError(
            f"{path} is a MATLAB 7.3 file (HDF5); expected MATLAB 5; save it again with scipy.io.savemat, or with -v7 in MATLAB"
        ) from None
    except Unreadable as error:
        raise InputError(
            f"{path} cannot be read as a .mat file ({error}); expected one that scipy.io.savemat wrote"
        ) from None
    missing = [name for name in NUMBERS if name not in said]
    if missing:
        raise InputError(
            f"{path} holds {', '.join(held)[:300] or 'nothing'}; expected {', '.join(missing)} too, as University-1652's "
            "test.py saves them; save them under these names"
        )
    return said


def _side(path: str, said: dict[str, Any], name: str) -> _EmbeddingSet:
    with np.errstate(over="ignore"):  # an infinite length is refused below
        features_ND = np.asarray(said[f"{name}_f"], np.float32)
    label_N = np.ravel(said[f"{name}_label"])
    if not np.isfinite(label_N).all() or (np.abs(label_N) >= 2**63).any():
        raise InputError(
            f"{path} has {name}_label that are no whole numbers; expected one per image; save them again"
        )
    labels = [int(label) for label in label_N]
    paths: list[str] = said.get(f"{name}_path", np.array([], np.str_)).tolist()
    if (
        features_ND.ndim != 2
        or len(features_ND) != len(labels)
        or (paths and len(paths) != len(labels))
    ):
        raise InputError(
            f"{path} has {name}_f of shape {features_ND.shape}, {len(labels)} labels and {len(paths)} paths; expected one row, "
            "one label and one path (or no paths at all) for each image; save them again"
        )
    if name == "gallery" and JUNK_LABEL in labels:
        kept = [row for row, label in enumerate(labels) if label != JUNK_LABEL]
        features_ND, labels = features_ND[kept], [labels[row] for row in kept]
        paths = [paths[row] for row in kept] if paths else []
    length_N1 = np.linalg.norm(features_ND.astype(np.float64), axis=1, keepdims=True)
    if not np.all(np.isfinite(length_N1) & (length_N1 > 0)):
        row = int(np.argmin(np.isfinite(length_N1) & (length_N1 > 0)))
        raise InputError(
            f"row {row} of {name}_f in {path} has length {length_N1[row, 0]:g}; expected vectors of finite length above 0; "
            "leave that image out"
        )
    return _EmbeddingSet(
        features_ND=(features_ND / length_N1).astype(np.float32), labels=labels, paths=paths
    )


def _write(
    table: str, side: _EmbeddingSet, split: Split, view: View, fingerprint: str, by_path: bool
) -> int:
    folders = [path.replace("\\", "/").split("/") for path in side.paths]
    if by_path and folders and len(folders[0]) > 2:
        named = next(
            (each for each in View if str(each) in folders[0][-3]), None
        )  # .../query_drone/0001/image-01.jpeg
        view = named or view
    locations = (
        [parts[-2] for parts in folders] if by_path else [str(label) for label in side.labels]
    )
    stems = (
        [parts[-1].rsplit(".", 1)[0] for parts in folders]
        if side.paths
        else [""] * len(side.labels)
    )
    keys, seen = [], set[str]()
    for row, (location, stem) in enumerate(zip(locations, stems, strict=True)):
        ours = stem.startswith(
            make_key(split, view, location, "")
        )  # exported by us: it comes back under its key
        key = stem if ours else make_key(split, view, location, stem or f"{row:06d}")
        key = make_key(split, view, location, f"{stem}-{row:06d}") if key in seen else key
        seen.add(key)
        keys.append(key)
    names = [
        f"{split}-{view}-{first // PART_ROWS:06d}.parquet"
        for first in range(0, len(keys), PART_ROWS)
    ]
    strangers = sorted(set(storage.list_names(table)) - set(names))
    if strangers:
        raise InputError(
            f"{table} holds {strangers[0]}, which is not of these features; choose another --out"
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
                embeddings_BD=side.features_ND[rows],
            ),
            PartFooter(fingerprint=fingerprint, shard_sha256=f"{fingerprint}-{number}", rows=count),
        )
    return len(keys)
