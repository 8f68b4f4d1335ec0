"""The positions of an index's images and their spacing."""

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
    """A square of positions a thousandth of a degree apart on the equator, each twice, and a row
    without a position."""
    step = np.arange(side) * 1e-3
    positions = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    positions = np.concatenate([positions, positions, [[np.nan, np.nan]]])
    names = np.array([f"{number}" for number in range(len(positions))])
    return GalleryMap(
        keys=names, locations=names, positions_N2=positions, rows=rows or len(positions)
    )


def test_gallery_map_spacing_of_a_grid() -> None:
    assert on_a_grid(5).spacing_m == pytest.approx(1e-3 * DEGREE_M, rel=1e-4)


def test_gallery_map_spacing_of_a_sample() -> None:
    grid = on_a_grid(5)
    assert on_a_grid(5, 4 * len(grid.keys)).spacing_m == pytest.approx(0.5e-3 * DEGREE_M, rel=1e-4)


def test_gallery_map_spacing_needs_two_positions() -> None:
    assert on_a_grid(1).spacing_m is None


def test_gallery_map_spacing_is_that_of_the_finest_level() -> None:
    """Tiles of twice the side have the same middles, or lie a tenth of a step beside them."""
    fine = on_a_grid(9).positions_N2
    coarse = on_a_grid(9).positions_N2[::2] + 1e-4
    same = on_a_grid(9).positions_N2[::3]
    both = np.concatenate([fine, coarse, same])
    sides_N = np.repeat([60.0, 120.0, 240.0], [len(fine), len(coarse), len(same)])
    names = np.array([f"{number}" for number in range(len(both))])
    gallery = GalleryMap(
        keys=names, locations=names, positions_N2=both, sides_N=sides_N, rows=len(both)
    )
    assert gallery.level_sides_m == [60.0, 120.0, 240.0]
    assert gallery.finest_side_m == 60.0
    assert gallery.spacing_m == pytest.approx(1e-3 * DEGREE_M, rel=1e-4)
    assert gallery.position_count == pytest.approx(81)
    coarsest = gallery.nearest(0, 0, 3, 230.0)
    assert gallery.sides_N is not None
    assert gallery.sides_N[coarsest].tolist() == [240.0] * 3
    unlevelled = GalleryMap(keys=names, locations=names, positions_N2=both, rows=len(both))
    assert unlevelled.spacing_m != pytest.approx(1e-3 * DEGREE_M, rel=0.1)


def test_gallery_map_nearest_across_180_degrees() -> None:
    positions = np.array([[0, 179.9], [0, -179.99], [0, 170.0], [np.nan, np.nan]])
    names = np.array(list("abcd"))
    gallery = GalleryMap(keys=names, locations=names, positions_N2=positions, rows=4)
    assert gallery.nearest(0, 179.99, 3).tolist() == [1, 0, 2]
    assert gallery.nearest(0, 179.99, 1).tolist() == [1]


def test_gallery_map_has_all_rows_of_an_index(tmp_path: Path) -> None:
    table = write_gallery(tmp_path / "table", parts=2, rows=10)
    build_index(IndexSettings(table=str(table), out=str(tmp_path / "index"), view=None, split=None))
    gallery = read_gallery_map(Index(str(tmp_path / "index")))
    assert gallery.rows == len(gallery.keys) == 60
    assert np.isnan(gallery.positions_N2[:, 1]).sum() == 12  # every fifth row has no longitude
    assert gallery.spacing_m is not None


def test_gallery_map_without_removed_locations(tmp_path: Path) -> None:
    table = write_gallery(tmp_path / "table", parts=2, rows=10)
    out = str(tmp_path / "index")
    build_index(IndexSettings(table=str(table), out=out, split=Split.GALLERY))
    remove_locations(out, ["10003"])
    gallery = read_gallery_map(Index(out))
    assert gallery.rows == len(gallery.keys) == 19
    assert "gallery-1-3" not in gallery.keys
