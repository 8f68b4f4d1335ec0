"""A flight over a map: where a survey takes its photos, and, of a survey or a spiral, when they are
taken and what odometry measures.

In: a map's size and a camera's reach, or rows of photos.csv. Out: points on parallel lines in the
order of time, times, and the table of displacements with errors. NumPy only, no I/O.
Shapes: N photos, 2 = (east, north) in metres.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from pipeline.camera.local_plane import LocalPlane
from pipeline.core.arrays import Doubles
from pipeline.core.errors import InputError

LEAST_ERROR_M = 0.01
"Of odometry where the camera did not move."


def survey_point(
    number: int, every_m: float, line_m: float, side_m: tuple[float, float], margin_m: float
) -> tuple[float, float, float]:
    """Metres right and down from a map's upper left corner of photo `number`, and the direction of
    the flight there, degrees clockwise from the map's upper side.

    Lines run from left to right and back, `line_m` apart, `margin_m` from the edges, and are joined
    at their ends. Raises InputError where the map has no room for as many photos.
    """
    across, down = (side - 2 * margin_m for side in side_m)
    lines = 1 + max(0, math.floor(down / line_m))
    gone_m = number * every_m
    line, along = divmod(gone_m, across + line_m) if across > 0 else (math.inf, 0.0)
    if across <= 0 or down < 0 or line >= lines or (line == lines - 1 and along > across):
        raise InputError(
            f"the map of {side_m[0]:.0f} x {side_m[1]:.0f} m has no room for photo {number} of a "
            f"survey with lines {line_m:g} m apart, {margin_m:.0f} m from its edges; expected a "
            "larger map; take fewer photos, or more often, or fly lower"
        )
    forth = line % 2 == 0
    x_m = margin_m + (min(along, across) if forth else across - min(along, across))
    y_m = margin_m + line * line_m + max(0.0, along - across)
    if along > across:
        return x_m, y_m, 180.0
    return x_m, y_m, 90.0 if forth else 270.0


def camera_of_row(row: Mapping[str, str]) -> tuple[float, float]:
    """The camera's latitude and longitude by a row of photos.csv, whose own are the ground's."""
    away_m = float(row["altitude_m"]) / math.tan(math.radians(-float(row["pitch_deg"])))
    heading = math.radians(float(row["heading_deg"]))
    plane = LocalPlane(lat=float(row["lat"]), lon=float(row["lon"]))
    behind_12 = -away_m * np.array([[math.sin(heading), math.cos(heading)]])
    [[lat, lon]] = plane.to_degrees(behind_12).tolist()
    return lat, lon


def camera_moves(rows: Sequence[Mapping[str, str]]) -> Doubles:
    """From each camera of the rows to the next, east and north in metres: (N - 1, 2)."""
    cameras_N2 = np.array([camera_of_row(row) for row in rows])
    moves = [
        LocalPlane(lat=float(here[0]), lon=float(here[1])).to_metres(there[None])[0]
        for here, there in pairwise(cameras_N2)
    ]
    return np.array(moves, np.float64).reshape(-1, 2)


def time_rows(names: Sequence[str], steps_m: Doubles, speed: float) -> list[dict[str, str]]:
    """The times of N photos, seconds from the first, with `steps_m` (N - 1) flown between them at
    `speed` metres per second."""
    seconds_N = np.concatenate([[0.0], np.cumsum(steps_m) / speed])
    return [{"photo": name, "time": f"{at:.3f}"} for name, at in zip(names, seconds_N, strict=True)]


def odometry_rows(
    names: Sequence[str], moves_M2: Doubles, error: float, seed: int
) -> list[dict[str, str]]:
    """Displacements (N - 1, 2) of the camera between N photos, each part with a normal error of
    `error` of the distance. The first row is empty."""
    rng = np.random.default_rng(seed)
    found = [{"photo": names[0], "east_m": "", "north_m": "", "error_m": ""}]
    for name, moved_2 in zip(names[1:], moves_M2, strict=True):
        error_m = max(error * float(np.linalg.norm(moved_2)), LEAST_ERROR_M)
        east, north = (moved_2 + error_m * rng.normal(size=2)).tolist()
        found.append(
            {
                "photo": name, "east_m": f"{east:.3f}", "north_m": f"{north:.3f}",
                "error_m": f"{error_m:.3f}",
            }
        )  # fmt: skip
    return found
