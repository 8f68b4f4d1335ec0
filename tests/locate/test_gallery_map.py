"""An index's images on the map."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.core.geo import EARTH_RADIUS_M
from pipeline.core.records import Split
from pipeline.index.build import build_index
from pipeline.index.searcher import Index
from pipeline.index.settings import IndexSettings
from pipeline.index.update import remove_locations
from pipeline.locate.gallery_map import GalleryMap, read_gallery_map
from tests.index.index_tables import write_gallery

DEGREE_M = EARTH_RADIUS_M * np.pi / 180


def on_a_grid(side: int, rows: int | None = None) -> GalleryMap:
    """A square of positions a thousandth of a degree apart on the equator, each there twice, and
    one without a position.
    """
    step = np.arange(side) * 1e-3
    places = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    places = np.concatenate([places, places, [[np.nan, np.nan]]])
    names = np.array([f"{number}" for number in range(len(places))])
    return GalleryMap(keys=names, positions_N2=places, rows=rows or len(places))


def test_the_spacing_is_the_way_to_the_next_other_position() -> None:
    assert on_a_grid(5).spacing_m == pytest.approx(1e-3 * DEGREE_M, rel=1e-4)


def test_a_sample_of_a_quarter_is_twice_as_far_apart_as_the_gallery() -> None:
    grid = on_a_grid(5)
    assert on_a_grid(5, 4 * len(grid.keys)).spacing_m == pytest.approx(0.5e-3 * DEGREE_M, rel=1e-4)


def test_without_two_positions_there_is_no_spacing() -> None:
    assert on_a_grid(1).spacing_m is None


def test_the_nearest_are_found_across_the_meridian_of_180_degrees() -> None:
    places = np.array([[0, 179.9], [0, -179.99], [0, 170.0], [np.nan, np.nan]])
    names = np.array(list("abcd"))
    gallery = GalleryMap(keys=names, positions_N2=places, rows=4)
    assert gallery.nearest(0, 179.99, 3).tolist() == [1, 0, 2]
    assert gallery.nearest(0, 179.99, 1).tolist() == [1]


def test_the_rows_of_an_index_are_on_its_map(tmp_path: Path) -> None:
    table = write_gallery(tmp_path / "table", parts=2, rows=10)
    build_index(IndexSettings(table=str(table), out=str(tmp_path / "index"), view=None, split=None))
    gallery = read_gallery_map(Index(str(tmp_path / "index")))
    assert gallery.rows == len(gallery.keys) == 60
    assert np.isnan(gallery.positions_N2[:, 1]).sum() == 12  # every fifth row has no longitude
    assert gallery.spacing_m is not None


def test_removed_locations_are_on_the_map_no_more(tmp_path: Path) -> None:
    table = write_gallery(tmp_path / "table", parts=2, rows=10)
    out = str(tmp_path / "index")
    build_index(IndexSettings(table=str(table), out=out, split=Split.GALLERY))
    remove_locations(out, ["10003"])
    gallery = read_gallery_map(Index(out))
    assert gallery.rows == len(gallery.keys) == 19
    assert "gallery-1-3" not in gallery.keys
