"""Parts of an embedding: counted from the vectors, and each measured alone."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.arrays import Floats
from pipeline.core.records import View
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.features.table import open_table
from pipeline.retrieval.embedding_set import embedding_set_from_array
from pipeline.retrieval.parts import (
    cosines_by_part,
    count_parts,
    detect_parts,
    measure_parts,
    select_parts,
)
from pipeline.retrieval.tasks import Task


def made(rows: int, parts: int, part_dim: int, seed: int = 0) -> Floats:
    """Unit vectors of so many parts of equal length."""
    raw = np.random.default_rng(seed).standard_normal((rows, parts, part_dim))
    raw /= np.linalg.norm(raw, axis=2, keepdims=True) * np.sqrt(parts)
    return raw.reshape(rows, -1).astype(np.float32)


@given(parts=st.integers(1, 16), part_dim=st.integers(7, 40), half=st.booleans())
def test_count_parts_from_vectors_float16_or_not(parts: int, part_dim: int, half: bool) -> None:
    vectors = made(20, parts, part_dim)
    assert count_parts(vectors.astype(np.float16).astype(np.float32) if half else vectors) == parts


def test_count_parts_of_vectors_without_parts_is_one() -> None:
    whole = made(5, 1, 64)
    assert count_parts(whole) == 1
    assert count_parts(made(5, 2, 32) + np.float32(0.01)) == 1
    assert count_parts(np.empty((0, 8), np.float32)) == 1
    assert (
        detect_parts(
            embedding_set_from_array(
                np.empty(0, np.str_), np.empty(0, np.str_), np.empty((0, 8), np.float32)
            )
        )
        == 1
    )


def test_cosines_by_part_average_to_the_score() -> None:
    one, other = made(6, 4, 9), made(6, 4, 9, seed=1)
    found = cosines_by_part(one, other, 4)
    assert found.shape == (6, 4)
    assert found.mean(1) == pytest.approx((one * other).sum(1), abs=1e-6)
    assert cosines_by_part(one, one, 4) == pytest.approx(np.ones((6, 4)), abs=1e-6)
    one, other = (
        np.array([row], np.float32) / np.float32(np.sqrt(2))
        for row in ([0.6, 0.8, 1, 0], [1, 0, 0, 1])
    )
    assert cosines_by_part(one, other, 2)[0] == pytest.approx([0.6, 0])


def test_select_parts_restores_unit_length() -> None:
    names = np.array(["a", "b"], np.str_)
    [block] = select_parts(embedding_set_from_array(names, names, made(2, 4, 3)), 4, (0, 2)).blocks(
        10
    )
    assert np.linalg.norm(block, axis=1) == pytest.approx(np.ones(2), abs=1e-6)
    assert block[:, :3] == pytest.approx(made(2, 4, 3)[:, :3] * np.sqrt(2))


def test_measure_parts_alone_and_without_each(tmp_path: Path) -> None:
    """Part 2 shows the place, parts 1 and 3 are noise: it finds all alone, and without it little is
    found.
    """
    places = [f"{i:02d}" for i in range(24)]
    right = made(24, 1, 64)
    for split, view, seed in (("query", "drone", 1), ("gallery", "satellite", 2)):
        noise = made(24, 2, 64, seed)
        vectors = np.concatenate(
            [noise[:, :64] * np.sqrt(2), right, noise[:, 64:] * np.sqrt(2)], axis=1
        ) / np.sqrt(3)
        write_part(
            f"{tmp_path}/{split}.parquet",
            PartRows(
                keys=[f"{split}-{p}" for p in places],
                locations=places,
                views=[view] * 24,
                splits=[split] * 24,
                lats=[None] * 24,
                lons=[None] * 24,
                embeddings_BD=vectors.astype(np.float32),
            ),
            PartFooter(fingerprint="f", shard_sha256=split, rows=24),
        )
    table = open_table(str(tmp_path))
    rows = measure_parts(Task(query_view=View.DRONE, gallery_view=View.SATELLITE), table, table)
    found = {(row["kept"], row["part"]): row["r1"] for row in rows}
    assert found["alone", 2] == found["without", 1] == found["without", 3] == 1
    assert max(found["alone", 1], found["alone", 3], found["without", 2]) < 0.5
    assert {row["parts"] for row in rows} == {3}
