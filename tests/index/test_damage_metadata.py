"""The metadata of an index,
damaged by flipped bits, zeroed blocks, truncation and removal: rejected, or read as it was.
"""

from pathlib import Path

from pipeline.core.integrity import FileChecksum
from pipeline.index.metadata import (
    METADATA_FILE,
    IndexMetadata,
    PartMetadata,
    SearchParams,
    read_metadata,
    write_metadata,
)
from tests.damaging import (
    count_detected,
    raising_if_missing,
)


def test_index_json_damaged_is_rejected(tmp_path: Path) -> None:
    part = PartMetadata(
        faiss="index.faiss",
        ids="ids.arrow",
        first_row=0,
        rows=5,
        table_parts={"gallery-drone-000000.parquet": "s" * 64},
        files={"index.faiss": FileChecksum(bytes=9, sha256="0" * 64)},
    )
    facts = IndexMetadata(
        factory="Flat",
        metric="inner product",
        rows=5,
        dimension=8,
        fingerprint="f" * 64,
        encoding=None,
        table="/t",
        settings={"split": None},
        reason="few rows",
        refine="none",
        on_disk=False,
        search_params=SearchParams(nprobe_or_ef=1),
        target_recall=0.9,
        unit_rows=9,
        part_rows=9,
        training_sample=0,
        build_seconds=0.1,
        bytes_per_vector=8.0,
        expected_bytes=None,
        measured={"recall_at_10": 1.0},
        parts=(part,),
        trained={},
    )
    write_metadata(str(tmp_path), facts)
    path = tmp_path / METADATA_FILE
    assert (
        count_detected(path, raising_if_missing(path, lambda: read_metadata(str(tmp_path))), 400)
        > 300
    )
