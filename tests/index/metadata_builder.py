"""Metadata of an index with defaults, for tests that build no index."""

from dataclasses import replace
from typing import Any

from pipeline.core.integrity import FileChecksum
from pipeline.features.encoding import EncodingConfig
from pipeline.index.metadata import IndexMetadata, PartMetadata, SearchParams

FILE = FileChecksum(bytes=10, sha256="0" * 64)


def make_metadata(**changes: Any) -> IndexMetadata:
    """Metadata of two rows in one part, with every optional field set but `expected_bytes`."""
    metadata = IndexMetadata(
        factory="Flat",
        metric="inner product",
        rows=2,
        dimension=4,
        fingerprint="0" * 64,
        encoding=EncodingConfig(mirror=True, resizer="torch", precision="float32"),
        table="/nowhere",
        settings={"split": None},
        reason="small",
        refine="none",
        on_disk=False,
        search_params=SearchParams(nprobe_or_ef=1),
        target_recall=0.95,
        unit_rows=2,
        part_rows=2,
        training_sample=0,
        build_seconds=0.1,
        bytes_per_vector=16.0,
        expected_bytes=None,
        measured={"recall_at_1": 1.0},
        parts=(
            PartMetadata(
                faiss="index.faiss",
                ids="ids.arrow",
                first_row=0,
                rows=2,
                table_parts={"query-drone-000000.parquet": "0" * 64},
                files={"index.faiss": FILE, "ids.arrow": FILE},
            ),
        ),
        trained={"trained.faiss": FILE},
    )
    return replace(metadata, **changes)
