"""The JSON files of an evaluation's folder: `evaluation.json` carries its own checksum and those of
the other lists.

In: a folder. Out: the validated rows of its files, or InputError for a damaged one.
"""

import json
from collections.abc import Mapping
from typing import Any

from pipeline.core import json_files, parquet, storage
from pipeline.core.errors import InputError
from pipeline.core.integrity import sha256_of

METRICS_FILE, RESULTS_FILE, INPUTS_FILE = "metrics.json", "queries.parquet", "evaluation.json"
VIEWS_FILE, GROUPS_FILE, PARTS_FILE, GAP_FILE = (
    "views.json",
    "groups.json",
    "parts.json",
    "view_gap.json",
)
CHECKSUMS_FIELD = "files"


def write_inputs(folder: str, inputs: Mapping[str, Any], metrics: bytes | None = None) -> None:
    """Write the inputs of an evaluation and the checksums of its files: as they are, and of
    `metrics.json` as it will be (`metrics`).
    """
    files = {
        name: sha256_of(data)
        for name in (VIEWS_FILE, GROUPS_FILE, PARTS_FILE, GAP_FILE, METRICS_FILE)
        if (data := _bytes(folder, name))
    }
    if metrics is not None:
        files[METRICS_FILE] = sha256_of(metrics)
    json_files.write_checksummed(
        storage.join(folder, INPUTS_FILE), {**inputs, CHECKSUMS_FIELD: files}
    )


def read_inputs(folder: str) -> dict[str, Any] | None:
    """The inputs of an evaluation; None if it has no record of them.

    Raises InputError if the record is damaged.
    """
    path = storage.join(folder, INPUTS_FILE)
    try:
        return json_files.read_checksummed(path) if storage.exists(path) else None
    except ValueError as error:
        raise _damaged(folder, INPUTS_FILE, str(error)) from None


def results_intact(folder: str, inputs: Mapping[str, Any]) -> bool:
    """Whether every list and the per-query rows of a finished evaluation match their checksums."""
    lists = inputs.get(CHECKSUMS_FIELD, {}).items()
    return parquet.parquet_intact(storage.join(folder, RESULTS_FILE)) and all(
        (data := _bytes(folder, name)) and sha256_of(data) == checksum for name, checksum in lists
    )


def read_result_rows(folder: str, name: str) -> list[dict[str, Any]]:
    """The rows of one of its lists; none if it was not written.

    Raises InputError if the list is damaged.
    """
    checksum = (read_inputs(folder) or {}).get(CHECKSUMS_FIELD, {}).get(name)
    data = _bytes(folder, name)
    if checksum is not None and data is None:
        raise _damaged(folder, name, "it is missing")
    if checksum is not None and data is not None and sha256_of(data) != checksum:
        raise _damaged(folder, name, f"its SHA-256 differs from the one in {INPUTS_FILE}")
    try:
        rows = [] if data is None else json.loads(data)
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise ValueError("it does not hold rows")
    except (ValueError, RecursionError) as error:
        raise _damaged(folder, name, str(error)) from None
    return rows


def _bytes(folder: str, name: str) -> bytes | None:
    path = storage.join(folder, name)
    return storage.read_bytes(path) if storage.exists(path) else None


def _damaged(folder: str, name: str, reason: str) -> InputError:
    return InputError(
        f"{storage.join(folder, name)} is damaged ({reason}), expected what jobs/evaluate.py "
        f"wrote; delete {folder} and evaluate again with jobs/evaluate.py"
    )
