"""Files for other programs: the challenge's answer file and the `.mat` file of features.

In: per-query rows, feature tables. Out: `answer.txt`, one line per query with the ids of its ten
best gallery images, best first, between tabs, as University-1652's test_160k.py writes it for the
workshop's challenge; and `pytorch_result.mat` with gallery_f, gallery_label, gallery_path, query_f,
query_label, query_path, as its test.py saves them.
"""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.io

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.features.table import FeatureTable
from pipeline.shards.shard_set import ShardSet

MAX_MAT_BYTES = 2**32 - 1  # of one array in a MATLAB 5 file


def source_file_names(shards: ShardSet) -> dict[str, str]:
    """The name of each key's source file, without its folder."""
    return {key: path.rsplit("/", 1)[-1] for key, path in shards.column("path").items()}


def answer_text(
    rows: Sequence[dict[str, Any]],
    names: dict[str, str] | None = None,
    order: Sequence[str] | None = None,
) -> str:
    """The answer file of one task's per-query rows.

    `names`: file name of each key; a gallery image's id is its file's name without ending, or,
    without `names`, its location, which in University-1652's satellite gallery is the same.
    `order`: the queries' file names in the order that the challenge requires (its
    query_drone_name.txt); without it, the rows' order.

    Raises InputError if a query in the order is missing, or two have one name.
    """
    if order is not None:
        by_name: dict[str, dict[str, Any]] = {}
        for row in rows:
            name = (names or {}).get(row["query"], row["query"])
            if by_name.setdefault(name, row) is not row:
                raise InputError(
                    f"two queries come from files named {name}; expected each name once, as in "
                    "the challenge's masked test set; leave the order out"
                )
        missing = [name for name in order if name not in by_name]
        if missing:
            raise InputError(
                f"{len(missing)} of {len(order)} names in the order were not queried, the first is "
                f"{missing[0]}; expected file names of the queries; give the --shards that were "
                "embedded, and the list that belongs to them"
            )
        rows = [by_name[name] for name in order]
    lines = []
    for row in rows:
        ids = (
            [names[key].rsplit(".", 1)[0] for key in row["top_keys"]]
            if names
            else row["top_locations"]
        )
        lines.append("\t".join(ids) + "\n")
    return "".join(lines)


def mat_bytes(
    queries: FeatureTable, gallery: FeatureTable, query_view: View, gallery_view: View
) -> bytes:
    """The features of one task as a MATLAB 5 file. Labels are integers there: the location names if
    all are integers, else their indices among the sorted names. A path's folder is the location's
    name in either case.

    Raises InputError if the features do not fit such a file.
    """
    tables = {
        "query": queries.select(Split.QUERY, query_view),
        "gallery": gallery.select(Split.GALLERY, gallery_view),
    }
    labels = {name: table.labels() for name, table in tables.items()}
    locations = np.unique(np.concatenate([own.locations for own in labels.values()]))
    numbers = {
        location: int(location) if location.isdecimal() else -1 for location in locations.tolist()
    }
    if len(set(numbers.values())) < len(locations) or -1 in numbers.values():
        numbers = {location: index for index, location in enumerate(locations.tolist())}
    content: dict[str, Any] = {}
    for name, table in tables.items():
        size = table.rows * table.dimension * 4
        if size > MAX_MAT_BYTES:
            raise InputError(
                f"the {name} features take {size:,} bytes; expected at most {MAX_MAT_BYTES:,}, the "
                "limit of an array in a .mat file; leave the export out and read the Parquet table"
            )
        own, folder = labels[name], f"{name}_{'-'.join(table.views)}"
        content[f"{name}_f"] = table.embeddings()
        content[f"{name}_label"] = np.array(
            [[numbers[location] for location in own.locations.tolist()]], np.int64
        )
        pairs = zip(own.locations.tolist(), own.keys.tolist(), strict=True)
        content[f"{name}_path"] = np.array(
            [f"{folder}/{location}/{key}" for location, key in pairs]
        )
    stream = io.BytesIO()
    scipy.io.savemat(stream, content)
    return stream.getvalue()


def read_answer_order(path: str) -> list[str]:
    """The file names in a challenge's list of queries, without folders.

    Raises InputError if there is no such file.
    """
    if not storage.exists(path):
        raise InputError(
            f"no list of query names at {path}; expected a text file with one file name per line; "
            "check the path"
        )
    lines = storage.read_bytes(path).decode().splitlines()
    return [line.strip().rsplit("/", 1)[-1] for line in lines if line.strip()]
