"""Tables of displacements: sums over chains, gaps, and what is refused."""

from pathlib import Path

import pytest

from pipeline.core.errors import InputError
from pipeline.locate.odometry import (
    COLUMNS,
    Travelled,
    odometry_rows,
    read_odometry,
    travelled,
)
from pipeline.locate.photo_files import parse_rows

HEADER = "photo,east_m,north_m,error_m\n"


def ways(text: str, photos: list[str]) -> list[Travelled]:
    rows = odometry_rows(parse_rows(HEADER + text, COLUMNS, "way.csv"), "way.csv")
    return travelled(rows, photos, "way.csv")


def test_odometry_sums_steps_and_variances() -> None:
    """A photo that is not located is a step on the way; a path's last part names it."""
    a, c = ways("a.jpg,9,9,1\nb.jpg,3,-1,3\nc.jpg,4,0.5,4\n", ["in/a.jpg", "c.jpg"])
    assert a.chain == c.chain
    assert (c.east_m - a.east_m, c.north_m - a.north_m) == (7, -0.5)
    assert c.variance_m2 - a.variance_m2 == 25


def test_odometry_gap_ends_a_chain() -> None:
    """An empty row is a gap before its photo; a photo without a row stands alone, for nobody knows
    from where the next one was measured."""
    a, b, c, d, e = ways("a,1,1,1\nb,,,\nc,5,0,2\ne,1,0,1\n", ["a", "b", "c", "d", "e"])
    assert a.chain != b.chain
    assert b.chain == c.chain
    assert (c.east_m - b.east_m, c.variance_m2 - b.variance_m2) == (5, 4)
    assert len({c.chain, d.chain, e.chain}) == 3


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("a,1,2,0\n", "has 1, 2, 0 for a; expected metres east and north and a standard"),
        ("a,1,x,1\n", "has 1, x, 1 for a"),
        ("a,1,,1\n", "has 1, , 1 for a"),
        ("a,inf,1,1\n", "has inf, 1, 1 for a"),
        ("a,1,1,nan\n", "has 1, 1, nan for a"),
        ("a,1,1,1\na,1,1,1\n", "two rows for a; expected one a photo"),
        ("b,1,1,1\na,1,1,1\n", "row of b before that of an earlier photo; expected rows in"),
        ("x,1,1,1\n", "rows for none of 2 photos, a among them"),
        ("", "has no rows with the columns photo, east_m, north_m, error_m"),
    ],
)
def test_odometry_wrong_table_is_refused(text: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        ways(text, ["a", "b"])


def test_odometry_without_table_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no table at .*check --odometry"):
        read_odometry(str(tmp_path / "none.csv"), ["a"])
    (tmp_path / "way.csv").write_text(HEADER + "a,1,2,3\n")
    [way] = read_odometry(str(tmp_path / "way.csv"), ["a"])
    assert (way.east_m, way.north_m, way.variance_m2) == (1, 2, 9)
