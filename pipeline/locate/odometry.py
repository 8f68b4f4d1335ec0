"""A table of displacements between photos -> how far the camera has travelled at each photo.

In: a CSV file with the columns photo, east_m, north_m, error_m in the order of time: the camera's
displacement since the photo before, and the standard deviation of either part. Out: per photo the
sums since the last gap, so that the displacement between any two photos is a difference.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.core.errors import InputError
from pipeline.locate.photo_files import read_rows

COLUMNS = ("photo", "east_m", "north_m", "error_m")


@dataclass(frozen=True, kw_only=True)
class Travelled:
    """The camera's way to a photo, summed from the last gap in the odometry."""

    chain: int
    "Photos of one chain have no gap between them; those of others are not comparable."
    east_m: float = 0.0
    "Metres since the beginning of the chain."
    north_m: float = 0.0
    "Likewise."
    variance_m2: float = 0.0
    "Variance of either sum, square metres: that of independent errors adds up."


@dataclass(frozen=True, kw_only=True)
class OdometryRow:
    """A row of the table."""

    photo: str
    step: tuple[float, float, float] | None
    "East, north and standard deviation, metres; None where the row's cells are empty."


def read_odometry(path: str, photos: Sequence[str]) -> list[Travelled]:
    """The way to each of `photos` (paths, in order of time), by the table at `path`.

    Raises InputError where it is not such a table, a number cannot be used, or its rows are in
    another order than the photos' times.
    """
    return travelled(odometry_rows(read_rows(path, COLUMNS, "--odometry"), path), photos, path)


def odometry_rows(rows: Sequence[dict[str, str]], path: str) -> list[OdometryRow]:
    """The rows of a table, checked. Raises InputError for a number that is none."""
    return [OdometryRow(photo=row["photo"], step=_step(row, path)) for row in rows]


def _step(row: dict[str, str], path: str) -> tuple[float, float, float] | None:
    cells = [row[name].strip() for name in COLUMNS[1:]]
    if not any(cells):
        return None
    try:
        east, north, error = map(float, cells)
    except ValueError:
        east = north = error = math.nan
    if not (math.isfinite(east) and math.isfinite(north) and 0 < error < math.inf):
        found = ", ".join(cells)
        raise InputError(
            f"{path} has {found} for {row['photo']}; expected metres east and north and a standard "
            "deviation above 0; correct the row, or leave its three cells empty"
        )
    return east, north, error


def travelled(rows: Sequence[OdometryRow], photos: Sequence[str], path: str) -> list[Travelled]:
    """The way to each photo. A chain ends before a photo without a row or with empty cells. Rows of
    photos that are not located are steps on the way between others.

    Raises InputError where a photo has two rows, none has one, or the rows are not in the order of
    `photos`.
    """
    numbers = _row_numbers(rows, photos, path)
    found: list[Travelled] = []
    at = Travelled(chain=0)
    done = 0  # rows walked through
    for photo, number in zip(photos, numbers, strict=True):
        if number is None:
            # It stands alone: rows that follow may begin before it.
            found.append(Travelled(chain=at.chain + 1))
            at = Travelled(chain=at.chain + 2)
            continue
        if number < done:
            raise InputError(
                f"{path} has the row of {photo} before that of an earlier photo; expected rows in "
                "the order of the photos' times; sort them, or check the times"
            )
        for row in rows[done : number + 1]:
            at = _after(at, row)
        done = number + 1
        found.append(at)
    return found


def _row_numbers(rows: Sequence[OdometryRow], photos: Sequence[str], path: str) -> list[int | None]:
    """The row of each photo, by its path or the last part of it."""
    by_name: dict[str, int] = {}
    for number, row in enumerate(rows):
        if row.photo in by_name:
            raise InputError(
                f"{path} has two rows for {row.photo}; expected one a photo; remove the other"
            )
        by_name[row.photo] = number
    found = [by_name.get(photo, by_name.get(photo.rpartition("/")[2])) for photo in photos]
    if photos and not any(number is not None for number in found):
        raise InputError(
            f"{path} has rows for none of {len(photos)} photos, {photos[0]} among them; expected "
            "their paths or file names in the column photo; check the names"
        )
    return found


def _after(at: Travelled, row: OdometryRow) -> Travelled:
    if row.step is None:
        return Travelled(chain=at.chain + 1)
    east, north, error = row.step
    return Travelled(
        chain=at.chain,
        east_m=at.east_m + east,
        north_m=at.north_m + north,
        variance_m2=at.variance_m2 + error**2,
    )
