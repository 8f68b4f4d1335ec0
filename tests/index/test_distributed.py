"""An index spread over actors returns the hits, and the errors, of one process."""

from pathlib import Path

import pytest

from pipeline.core.errors import InputError
from pipeline.core.filters import Filter
from pipeline.core.geo import Circle
from pipeline.core.records import Split, View
from pipeline.features.table import open_table
from pipeline.index.build import build_index
from pipeline.index.distributed import DistributedIndex
from pipeline.index.searcher import Index
from pipeline.index.settings import IndexSettings
from pipeline.index.update import remove_locations
from tests.index.index_tables import write_gallery


@pytest.fixture(scope="module")
def index(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """A table, and its index in three parts with a location removed."""
    folder = tmp_path_factory.mktemp("spread")
    table = str(write_gallery(folder / "table"))
    build_index(
        IndexSettings(
            table=table,
            out=str(folder / "index"),
            split=Split.GALLERY,
            view=View.SATELLITE,
            factory="IVF8,SQ8",
            parts=3,
        )
    )
    remove_locations(str(folder / "index"), ["00003"])
    return table, str(folder / "index")


def test_distributed_answers_equal_one_process(index: tuple[str, str], ray_cluster: None) -> None:
    table, path = index
    queries_QD = open_table(table).select(Split.QUERY).embeddings()
    here = Index(path)
    with DistributedIndex(path, actors=2) as spread:
        assert len(here.metadata.parts) == 3
        assert (len(spread), spread.dimension, spread.metadata.fingerprint) == (
            599,
            32,
            here.metadata.fingerprint,
        )
        for where in (
            None,
            Filter(near=Circle(lat=0.1, lon=1, radius_m=5_000)),
            Filter(locations=frozenset(["00003"])),
        ):
            assert spread.search(queries_QD, 12, where) == here.search(queries_QD, 12, where)
        with pytest.raises(InputError, match=r"expected \(queries, 32\)"):
            spread.search(queries_QD[:, :5])


def test_distributed_rejects_damaged_part_on_opening(
    index: tuple[str, str], ray_cluster: None
) -> None:
    _, path = index
    file = Path(path) / "index-000001.faiss"
    whole = file.read_bytes()
    file.write_bytes(whole[:-1])
    try:
        with pytest.raises(InputError, match=r"index-000001\.faiss has"):
            DistributedIndex(path, actors=3)
    finally:
        file.write_bytes(whole)
