"""The features of a whole map in one nearest-neighbour index: candidates where retrieval has none.

In: all windows of a map, and a photo's features. Out: the places of the map that the photo's
features vote for: they find what the encoder ranks low, also on another day (docs/results.md).
140 bytes a feature in memory.
Shapes: N features of the map, Q of a photo, K neighbours, M votes, 2 = (east, north) in metres.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import faiss
import numpy as np
from scipy.spatial import cKDTree

from pipeline.camera.local_plane import LocalPlane
from pipeline.core.arrays import Doubles, Floats
from pipeline.core.geo import Circle
from pipeline.core.progress import progress
from pipeline.matching.map_windows import MapWindows
from pipeline.matching.photo_features import MatchablePhoto
from pipeline.matching.refine import MatchableWindow, prepare_window

FAISS: Any = faiss
"Without types: FAISS's stubs lack the keyword arguments."
MOST_MAP_WINDOWS = 256
"""Of a map whose features are searched: 12 square kilometres in tiles of 55 m, half a minute a
square kilometre to make, some 200 MB. A larger map is left to the encoder."""
VOTE_RATIO = 0.85
"Of the distances of the nearest and the second nearest descriptor, as for windows."
LISTS_PER_ROOT, SEARCHED_LISTS, SAMPLE_PER_LIST, ROUNDS = 2, 12, 64, 8
"""Lists of N features: so many times the square root of N; how many of them a feature searches;
what their centres are learned from, and in how many rounds: seconds, not a minute."""
NEIGHBOURS = 10
"That are looked at to find two away from a place."
LEAST_VOTES = 4
"Fewer determine no homography."


@dataclass(frozen=True, kw_only=True)
class MapFeatures:
    """A map's features where they lie."""

    plane: LocalPlane
    points_N2: Floats
    "(east, north) in metres."
    metres_per_pixel_N: Floats
    "Of the map where they were found."
    angles_N: Floats
    "How they are turned, degrees clockwise."
    index: Any
    "FAISS's index of their descriptors (N, 128), which gives them back."
    reach_m: float
    "Votes within so many metres of each other are for one place."

    def places(
        self, photo: MatchablePhoto, most: int, away_from: Circle | None = None
    ) -> list[tuple[float, float]]:
        """The places (lat, lon) of the most votes, at most `most`, the best first. None of them
        lies within `away_from`, whose features do not count."""
        votes_M2 = self._votes(photo.features.descriptors_ND, away_from)
        found: list[tuple[float, float]] = []
        while len(found) < most and len(votes_M2) >= LEAST_VOTES:
            near = cKDTree(votes_M2).query_ball_point(votes_M2, self.reach_m)
            best = max(near, key=len)
            if len(best) < LEAST_VOTES:
                break
            middle_12 = np.median(votes_M2[best], axis=0)[None]
            [[lat, lon]] = self.plane.to_degrees(middle_12).tolist()
            found.append((lat, lon))
            votes_M2 = votes_M2[np.abs(votes_M2 - middle_12).max(axis=1) > 2 * self.reach_m]
        return found

    def window(self, lat: float, lon: float, half_m: float) -> MatchableWindow | None:
        """Those within `half_m` metres east, west, north and south of a position; None where there
        are none."""
        here_12 = self.plane.to_metres(np.array([[lat, lon]])).astype(np.float32)
        within = np.flatnonzero(np.abs(self.points_N2 - here_12).max(axis=1) <= half_m)
        if len(within) == 0:
            return None
        plane = LocalPlane(lat=lat, lon=lon)
        positions_N2 = self.plane.to_degrees(self.points_N2[within].astype(np.float64))
        return MatchableWindow(
            plane=plane,
            metres_per_pixel=float(np.median(self.metres_per_pixel_N[within])),
            ground_N2=plane.to_metres(positions_N2),
            descriptors_ND=self.index.reconstruct_batch(within),
            angles_N=self.angles_N[within],
        )

    def _votes(self, descriptors_QD: Floats, away_from: Circle | None) -> Doubles:
        """The ground (M, 2) of those features of the map that a photo's are clearly nearest to."""
        if len(descriptors_QD) == 0 or len(self.points_N2) < NEIGHBOURS:
            return np.zeros((0, 2))
        wanted = 2 if away_from is None else NEIGHBOURS
        parameters = FAISS.SearchParametersIVF(nprobe=SEARCHED_LISTS)
        distance_QK, row_QK = self.index.search(descriptors_QD, wanted, params=parameters)
        ground_QK2 = self.points_N2[row_QK].astype(np.float64)
        usable_QK = row_QK >= 0
        if away_from is not None:
            here_12 = self.plane.to_metres(np.array([[away_from.lat, away_from.lon]]))
            usable_QK &= np.linalg.norm(ground_QK2 - here_12, axis=2) > away_from.radius_m
        # The first two that are usable, nearest first.
        order_QK = np.argsort(~usable_QK, axis=1, kind="stable")[:, :2]
        both_Q = np.take_along_axis(usable_QK, order_QK, axis=1).all(axis=1)
        near_Q2 = np.take_along_axis(distance_QK, order_QK, axis=1)
        clear_Q = both_Q & (near_Q2[:, 0] < VOTE_RATIO**2 * near_Q2[:, 1])
        return np.asarray(ground_QK2[np.arange(len(order_QK)), order_QK[:, 0]][clear_Q])


def find_map_features(windows: MapWindows) -> MapFeatures | None:
    """The features of all of a map; None where it has none, or more than MOST_MAP_WINDOWS."""
    middles, half_m = windows.cover(MOST_MAP_WINDOWS)
    if not middles:
        return None
    plane = LocalPlane(lat=middles[0][0], lon=middles[0][1])
    points, descriptors, scales, angles = [], [], [], []
    with progress(len(middles), "features of the map", "windows") as meter:
        for lat, lon in middles:
            window = windows.compose(lat, lon, half_m)
            if window is not None:
                found = prepare_window(window)
                positions_N2 = found.plane.to_degrees(found.ground_N2)
                points.append(plane.to_metres(positions_N2).astype(np.float32))
                descriptors.append(found.descriptors_ND)
                angles.append(found.angles_N)
                scales.append(np.full(len(positions_N2), found.metres_per_pixel, np.float32))
            meter.advance()
    if sum(map(len, points)) < NEIGHBOURS:
        return None
    return MapFeatures(
        plane=plane,
        points_N2=np.concatenate(points),
        metres_per_pixel_N=np.concatenate(scales),
        angles_N=np.concatenate([one for one in angles if one is not None]),
        index=_index_of(np.concatenate(descriptors)),
        reach_m=min(windows.tile_sides_m()),
    )


def _index_of(descriptors_ND: Floats) -> Any:
    """Inverted lists over descriptors of 8 bits a number: the same ones each time."""
    lists = max(1, round(LISTS_PER_ROOT * math.sqrt(len(descriptors_ND))))
    lists = min(lists, max(1, len(descriptors_ND) // SAMPLE_PER_LIST))
    index = FAISS.index_factory(descriptors_ND.shape[1], f"IVF{lists},SQ8")
    index.cp.max_points_per_centroid, index.cp.niter = SAMPLE_PER_LIST, ROUNDS
    index.train(descriptors_ND)
    index.add(descriptors_ND)
    index.make_direct_map()
    return index


class MapSearch:
    """A map's features: those that are kept; if places are searched, else made."""

    def __init__(
        self, read: Callable[[], MapFeatures | None], make: Callable[[], MapFeatures | None]
    ) -> None:
        self._read, self._make = read, make
        self._made: MapFeatures | None = None

    @cached_property
    def _kept(self) -> MapFeatures | None:
        return self._read()

    @cached_property
    def _features(self) -> MapFeatures | None:
        self._made = self._kept or self._make()
        return self._made

    def window(self, lat: float, lon: float, half_m: float) -> MatchableWindow | None:
        """`MapFeatures.window` of those that are at hand: no window waits for all of a map."""
        known = self._made or self._kept
        return None if known is None else known.window(lat, lon, half_m)

    def places(
        self, photo: MatchablePhoto, most: int, away_from: Circle | None = None
    ) -> list[tuple[float, float]]:
        """`MapFeatures.places`; none where the map has no features that are searched."""
        features = self._features
        return [] if features is None else features.places(photo, most, away_from)
