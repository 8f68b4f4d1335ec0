"""The list of rejected images,
damaged by flipped bits, zeroed blocks, truncation and removal: rejected, or read as it was.
"""

from pathlib import Path

import pyarrow.parquet as pq

from pipeline.core import rejections
from pipeline.core.records import Rejection
from tests.damaging import (
    REMEDIES,
    damaged_versions,
    error_message,
)


def test_rejected_list_damaged_is_named(tmp_path: Path) -> None:
    rejections.write_rejections(
        str(tmp_path), [Rejection(path="a", reason="b", found="c")], keep=False
    )
    path = tmp_path / rejections.REJECTED_FILE
    good = path.read_bytes()
    for data in damaged_versions(good, 100):
        if data is None:
            continue
        path.write_bytes(data)
        said = error_message(
            lambda: rejections.write_rejections(
                str(tmp_path), [Rejection(path="d", reason="e", found="f")], keep=True
            )
        )
        if said is None:
            assert len(pq.read_table(path)) == 2
        else:
            assert str(path) in said
            assert REMEDIES.search(said)
