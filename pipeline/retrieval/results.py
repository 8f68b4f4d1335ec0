"""The JSON files of an evaluation's folder, read back: `evaluation.json` has a seal, and the hashes
of the others.

In: a folder. Out: what its files say, or a sentence where one is not what was written.
"""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from pipeline.core import json_files, parquet, storage
from pipeline.core.errors import InputError

METRICS_FILE, RESULTS_FILE, INPUTS_FILE = "metrics.json", "queries.parquet", "evaluation.json"
VIEWS_FILE, GROUPS_FILE, PARTS_FILE, GAP_FILE = (
    "views.json",
    "groups.json",
    "parts.json",
    "view_gap.json",
)
CHECKSUMS_FIELD = "files"


def write_inputs(folder: str, inputs: Mapping[str, Any], metrics: bytes | None = None) -> None:
    """Write what an evaluation was made from, and the hashes of its files: as they are, and of
    `metrics.json` as it will be.
    """
    files = {
        name: _hash(data)
        for name in (VIEWS_FILE, GROUPS_FILE, PARTS_FILE, GAP_FILE, METRICS_FILE)
        if (data := _bytes(folder, name))
    }
    if metrics is not None:
        files[METRICS_FILE] = _hash(metrics)
    json_files.write_checksummed(
        storage.join(folder, INPUTS_FILE), {**inputs, CHECKSUMS_FIELD: files}
    )


def read_inputs(folder: str) -> dict[str, Any] | None:
    """What an evaluation was made from; None where it does not say.

    Raises InputError where it is not what was written.
    """
    path = storage.join(folder, INPUTS_FILE)
    try:
        return json_files.read_checksummed(path) if storage.exists(path) else None
    except ValueError as error:
        raise _damaged(folder, INPUTS_FILE, str(error)) from None


def results_intact(folder: str, inputs: Mapping[str, Any]) -> bool:
    """Whether every list and the queries' rows of a finished evaluation are what was written."""
    lists = inputs.get(CHECKSUMS_FIELD, {}).items()
    return parquet.parquet_intact(storage.join(folder, RESULTS_FILE)) and all(
        (data := _bytes(folder, name)) and _hash(data) == said for name, said in lists
    )


def read_result_rows(folder: str, name: str) -> list[dict[str, Any]]:
    """The rows of one of its lists; none where it was not made.

    Raises InputError where it is not what was written.
    """
    said, data = (
        (read_inputs(folder) or {}).get(CHECKSUMS_FIELD, {}).get(name),
        _bytes(folder, name),
    )
    if said is not None and (data is None or _hash(data) != said):
        raise _damaged(
            folder,
            name,
            f"it has not the hash that {INPUTS_FILE} says" if data else "it is not there",
        )
    try:
        rows = [] if data is None else json.loads(data)
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise ValueError("something else than rows")
    except (ValueError, RecursionError) as error:
        raise _damaged(folder, name, str(error)) from None
    return rows


def _bytes(folder: str, name: str) -> bytes | None:
    path = storage.join(folder, name)
    return storage.read_bytes(path) if storage.exists(path) else None


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _damaged(folder: str, name: str, reason: str) -> InputError:
    return InputError(
        f"{storage.join(folder, name)} is damaged ({reason}), expected what jobs/evaluate.py wrote; delete {folder} and "
        "evaluate again with jobs/evaluate.py"
    )
