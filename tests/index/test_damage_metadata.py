"""The metadata of an index,
damaged by flipped bits, zeroed blocks, truncation and removal: rejected, or read as it was.
"""

from pathlib import Path

from pipeline.index.metadata import METADATA_FILE, read_metadata, write_metadata
from tests.damaging import count_detected, raising_if_missing
from tests.index.metadata_builder import make_metadata


def test_index_json_damaged_is_rejected(tmp_path: Path) -> None:
    write_metadata(str(tmp_path), make_metadata())
    path = tmp_path / METADATA_FILE
    look = raising_if_missing(path, lambda: read_metadata(str(tmp_path)))
    assert count_detected(path, look, 400) > 300
