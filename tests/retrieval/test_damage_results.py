"""The files of an evaluation,
damaged by flipped bits, zeroed blocks, truncation and removal: rejected, or read as it was.
"""

from functools import partial
from pathlib import Path

from pipeline.core import storage
from pipeline.retrieval.results import (
    INPUTS_FILE,
    METRICS_FILE,
    VIEWS_FILE,
    read_inputs,
    read_result_rows,
    write_inputs,
)
from tests.damaging import (
    count_detected,
    raising_if_missing,
)


def test_evaluation_damaged_is_rejected(tmp_path: Path) -> None:
    metrics = [
        {
            "task": "drone->satellite",
            "protocol": "full",
            "multi_query": False,
            "r1": 0.25,
            "ap": 0.5,
        }
    ]
    storage.write_json(str(tmp_path / VIEWS_FILE), [{"views": 3, "r1": 0.5}])
    write_inputs(
        str(tmp_path), {"ranked": {"queries": "q" * 64}, "shown": {}}, storage.encode_json(metrics)
    )
    storage.write_json(str(tmp_path / METRICS_FILE), metrics)
    for name, listed in ((METRICS_FILE, METRICS_FILE), (VIEWS_FILE, VIEWS_FILE)):
        read = partial(read_result_rows, str(tmp_path), listed)
        assert count_detected(tmp_path / name, read, 200) == 201
    path = tmp_path / INPUTS_FILE
    assert (
        count_detected(path, raising_if_missing(path, lambda: read_inputs(str(tmp_path))), 200)
        > 150
    )
