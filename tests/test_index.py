"""The index: finds what brute force finds, opens with plain FAISS, and refuses what it cannot be built from."""

from pathlib import Path

import faiss
import numpy as np
import pyarrow.parquet as pq
import pytest

from pipeline import storage
from pipeline.features import PartFooter, PartRows, open_table, write_part
from pipeline.index import Index, IndexSettings, build_index, choose_factory, exact_search, parse_bytes
from pipeline.records import InputError, Split, View


@pytest.fixture
def table(tmp_path: Path) -> str:
    """40 satellite rows of the gallery in two parts and 10 UAV queries, 16 dimensions."""
    rng = np.random.default_rng(0)
    for part, (split, view, count) in enumerate(
        [("gallery", "satellite", 25), ("gallery", "satellite", 15), ("query", "drone", 10)]
    ):
        vectors = rng.normal(size=(count, 16)).astype(np.float32)
        rows = PartRows(
            keys=[f"{split}-{part}-{n}" for n in range(count)], locations=[f"{part}{n:03d}" for n in range(count)],
            views=[view] * count, splits=[split] * count, lats=[float(n) for n in range(count)], lons=[None] * count,
            embeddings_BD=vectors / np.linalg.norm(vectors, axis=1, keepdims=True),
        )  # fmt: skip
        footer = PartFooter(fingerprint="f" * 64, shard_sha256="s", rows=count)
        write_part(str(tmp_path / "table" / f"{split}-{view}-{part:06d}.parquet"), rows, footer)
    return str(tmp_path / "table")


def build(features: str, out: Path, **changes: object) -> str:
    given = {"table": features, "out": str(out), "split": Split.GALLERY, "view": View.SATELLITE}
    build_index(IndexSettings(**(given | changes)))  # type: ignore[arg-type]
    return str(out)


def test_searching_finds_what_brute_force_finds(table: str, tmp_path: Path) -> None:
    index = Index(build(table, tmp_path / "index"))
    gallery, queries = open_table(table).select(Split.GALLERY), open_table(table).select(Split.QUERY).embeddings()
    scores = queries @ gallery.embeddings().T
    best = np.argsort(-scores, axis=1)[:, :5]
    labels = gallery.labels()
    for hits, rows, row_scores in zip(index.search(queries, k=5), best, scores, strict=True):
        assert [hit.key for hit in hits] == labels.keys[rows].tolist()
        assert [hit.location for hit in hits] == labels.locations[rows].tolist()
        assert [hit.lat for hit in hits] == labels.lats[rows].tolist()
        assert np.allclose([hit.score for hit in hits], row_scores[rows], atol=1e-6)
    assert np.array_equal(exact_search(queries, gallery, 5), best)


def test_plain_faiss_opens_the_index_and_ids_are_row_numbers(table: str, tmp_path: Path) -> None:
    out = build(table, tmp_path / "index")
    plain = faiss.read_index(storage.join(out, "index.faiss"))
    vectors = open_table(table).select(Split.GALLERY).embeddings()
    assert plain.ntotal == 40
    assert plain.search(vectors[7:8], 1)[1][0, 0] == 7
    rows = pq.read_table(storage.join(out, "ids.parquet")).to_pylist()
    assert rows[25] == {"row": 25, "key": "gallery-1-0", "location": "1000", "lat": 0.0, "lon": None}
    facts = storage.read_json(storage.join(out, "index.json"))
    assert (facts["factory"], facts["rows"], facts["recall_at_1"], facts["recall_at_10"]) == ("Flat", 40, 1.0, 1.0)


def test_another_factory_is_trained_and_its_recall_measured(table: str, tmp_path: Path) -> None:
    out = build(table, tmp_path / "index", factory="SQ4")
    facts = storage.read_json(storage.join(out, "index.json"))
    assert facts["training_sample"] == 40
    assert 0 < facts["recall_at_10"] <= 1
    assert facts["bytes_per_vector"] < 64


def test_a_finished_index_is_left_alone_and_other_rows_are_refused(
    table: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = Path(build(table, tmp_path / "index"))
    before = (out / "index.faiss").stat().st_mtime_ns
    build(table, out)
    assert "nothing to do" in capsys.readouterr().err
    assert (out / "index.faiss").stat().st_mtime_ns == before
    with pytest.raises(InputError, match="holds an index of other rows"):
        build(table, out, split=Split.QUERY, view=None)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"view": View.STREET}, "holds 40 gallery satellite, 10 query drone and none of it was asked for"),
        ({"factory": "Nonsense"}, "which FAISS cannot build over 16 dimensions"),
        ({"memory_budget": "1KB"}, "raise --memory-budget"),
        ({"memory_budget": "lots"}, "expected a number with KB, MB, GB or TB"),
        ({"target_recall": 1.5}, "expected a fraction"),
        ({"table": "/nowhere"}, "no feature table at /nowhere"),
    ],
)
def test_bad_calls_get_one_sentence(table: str, tmp_path: Path, changes: dict[str, object], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        build(table, tmp_path / "index", **changes)
    with pytest.raises(InputError, match="no index at"):
        Index(str(tmp_path / "index"))


def test_budgets_are_read_as_people_write_them() -> None:
    assert [parse_bytes(text) for text in ("4GB", "512 mb", "1.5G", "100")] == [4 * 10**9, 512 * 10**6, 15 * 10**8, 100]


def test_exact_search_is_chosen_while_it_fits() -> None:
    assert choose_factory(1000, 2048, 1000 * 2048 * 4) == "Flat"
    with pytest.raises(InputError):
        choose_factory(1001, 2048, 1000 * 2048 * 4)
