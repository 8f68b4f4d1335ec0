"""A flight's photos in time order -> its track: doubtful photos are settled by their neighbours.

In: for each photo its candidates, and how likely each of them, or none of them, is by itself. Out:
the likeliest chain of places that a UAV can fly, and for each photo how likely its place is in the
light of all photos. A photo may lie elsewhere, at none of its candidates: the chain then passes
over it, and the motion limit holds between the photos before and after. Exact: all chains are
weighed, by the Viterbi and the forward-backward recursions over pairs of photos. Pure, NumPy only.
Shapes: T photos, K candidates of one, N candidates of all photos in time order, M of those of the
photos before one.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.core.arrays import Doubles, Ints
from pipeline.core.errors import InputError
from pipeline.core.geo import EARTH_RADIUS_M, on_sphere

TRACK_CANDIDATES = 30
"""Candidates of a photo that the track may pass through. More than decide on a single answer: the
flight tells them apart, and what has not been found cannot be chosen."""
Combine = Callable[[Doubles], Doubles]


@dataclass(frozen=True, kw_only=True)
class Motion:
    """How a UAV may move between photos."""

    max_speed: float = 25.0
    "Metres per second over the ground; 25 is beyond most multicopters, fixed wings fly faster."
    slack_m: float = 0.0
    """Metres added to every way: how far a photo may lie from its gallery image's position, at both
    ends."""
    places: float = 1.0
    "Of the gallery: a photo by itself may show any of them."
    spacing_m: float = math.inf
    "Of the gallery: a square of this side for each place."
    elsewhere: float = 0.1
    "Share of the photos that are expected to show no place of the gallery."
    max_gap_photos: int = 60
    """Photos over which the limit holds: with as many between two places, the UAV may have come
    from anywhere, and mostly could have. It bounds the time that a long flight takes."""

    def __post_init__(self) -> None:
        if not self.max_speed > 0:
            raise InputError(f"--max-speed is {self.max_speed}, expected metres per second above 0")
        if not 0 < self.elsewhere < 1:
            raise InputError(
                f"--elsewhere is {self.elsewhere}, expected a share above 0 and below 1"
            )

    def gain(self, way_m: Doubles) -> Doubles:
        """Log of how much likelier a place is for lying within so many metres of where the UAV was:
        the gallery's places over those within reach, at least 1. A photo's own chances suppose that
        it may be anywhere."""
        within = np.pi * (way_m / self.spacing_m) ** 2
        return np.asarray(np.log(np.maximum(self.places / np.maximum(within, 1.0), 1.0)))


@dataclass(frozen=True, kw_only=True)
class TrackPhoto:
    """One photo of the flight."""

    time_s: float
    "Seconds since any moment."
    places_K2: Doubles
    "Latitude and longitude of its candidates; NaN where unknown: such a one is never chosen."
    log_chance_K: Doubles
    "Of each candidate, by the photo alone."
    log_elsewhere: float
    "Of none of them."


@dataclass(frozen=True, kw_only=True)
class TrackStart:
    """Where the flight roughly began, at the first photo's time."""

    lat: float
    lon: float
    radius_m: float


@dataclass(frozen=True, kw_only=True)
class SmoothedPhoto:
    """What the flight says of one photo."""

    chosen: int | None
    """Number of the candidate that the likeliest chain passes through; None: it passes over this
    photo."""
    probability: float
    "Of what was chosen, in the light of the whole flight."
    chance_K: Doubles
    "Of each candidate, likewise."


def smooth_track(
    photos: Sequence[TrackPhoto], motion: Motion, start: TrackStart | None = None
) -> list[SmoothedPhoto]:
    """The likeliest track through photos that are in time order.

    A chain's weight is the product of its photos' chances and of what the ways between them gain;
    one that is faster than the motion allows has none. Takes time for all pairs of candidates
    within `max_gap_photos` photos.
    """
    if not photos:
        return []
    flight = _Trellis.of(photos, start, motion)
    best_N, predecessor_N = flight.forward(lambda x_MK: x_MK.max(axis=0), trace=True)
    chosen = flight.backtrace(best_N, predecessor_N)
    before_N, _ = flight.forward(_logsum)
    after_N = flight.backward()
    total = _logsum(np.concatenate([[0.0], before_N])[:, None])[0]
    chance_N = np.exp(np.minimum(before_N + after_N - total, 0))
    smoothed = []
    for number, (begin, end) in enumerate(flight.spans):
        chance_K = chance_N[begin:end]
        at = chosen[number]
        probability = max(0.0, 1 - chance_K.sum()) if at is None else float(chance_K[at])
        smoothed.append(SmoothedPhoto(chosen=at, probability=float(probability), chance_K=chance_K))
    return smoothed


@dataclass(frozen=True, kw_only=True)
class _Trellis:
    """All candidates in one row. A chain's weight is told against that of the chain that passes
    over all photos, which is 1; so a photo passed over costs nothing, and a candidate gains its
    chance over that of elsewhere."""

    point_N3: Doubles
    time_N: Doubles
    gain_N: Doubles
    entry_N: Doubles
    "What beginning a chain at a candidate gains by the rough start; -inf where none may begin."
    spans: tuple[tuple[int, int], ...]
    "Of each photo's candidates."
    motion: Motion

    @staticmethod
    def of(photos: Sequence[TrackPhoto], start: TrackStart | None, motion: Motion) -> "_Trellis":
        ends = np.cumsum([len(photo.log_chance_K) for photo in photos]).tolist()
        place_N2 = np.concatenate([photo.places_K2.reshape(-1, 2) for photo in photos])
        gain_N = np.concatenate([photo.log_chance_K - photo.log_elsewhere for photo in photos])
        point_N3, entry_N = on_sphere(np.nan_to_num(place_N2)), np.zeros(len(gain_N))
        time_N = np.repeat(
            [photo.time_s for photo in photos], [len(photo.log_chance_K) for photo in photos]
        )
        if start:
            begun_13 = on_sphere(np.array([[start.lat, start.lon]]))
            way_N = start.radius_m + motion.slack_m + motion.max_speed * (time_N - photos[0].time_s)
            entry_N = np.where(
                _within_reach(begun_13, point_N3, way_N[None])[0], motion.gain(way_N), -np.inf
            )
        return _Trellis(
            point_N3=point_N3,
            time_N=time_N,
            gain_N=np.where(np.isnan(place_N2).any(axis=1), -np.inf, gain_N),
            entry_N=entry_N,
            spans=tuple(zip([0, *ends[:-1]], ends, strict=True)),
            motion=motion,
        )

    def flown(self, some: slice, others: slice) -> Doubles:
        """What flying from some candidates (M) to others (K) gains (M, K); -inf where it is too
        far.
        """
        way_MK = (
            self.motion.max_speed * np.abs(self.time_N[others][None] - self.time_N[some][:, None])
            + self.motion.slack_m
        )
        return np.where(
            _within_reach(self.point_N3[some], self.point_N3[others], way_MK),
            self.motion.gain(way_MK),
            -np.inf,
        )

    def forward(self, combine: Combine, trace: bool = False) -> tuple[Doubles, Ints]:
        """Weight of the chains up to and with each candidate, and for `trace` the candidate before
        it (-1: none).
        """
        weight_N, predecessor_N = np.full(len(self.gain_N), -np.inf), np.full(len(self.gain_N), -1)
        for number, (begin, end) in enumerate(self.spans):
            first = self.spans[max(0, number - self.motion.max_gap_photos)][0]
            near_MK = weight_N[first:begin, None] + self.flown(
                slice(first, begin), slice(begin, end)
            )
            far_1K = np.full((1, end - begin), _combine_all(combine, weight_N[:first]))
            to_MK = np.concatenate(
                [near_MK, far_1K, self.entry_N[None, begin:end]]
            )  # the last row: nothing came before
            weight_N[begin:end] = self.gain_N[begin:end] + combine(to_MK)
            if trace and end > begin:
                last_K = first + to_MK.argmax(axis=0)
                far = int(weight_N[:first].argmax()) if first else -1
                predecessor_N[begin:end] = np.where(
                    last_K < begin, last_K, np.where(last_K == begin, far, -1)
                )
        return weight_N, predecessor_N

    def backward(self) -> Doubles:
        """Weight of what may follow each candidate, nothing included."""
        weight_N = np.zeros(len(self.gain_N))
        for number in range(len(self.spans) - 1, -1, -1):
            begin, end = self.spans[number]
            last = self.spans[min(len(self.spans) - 1, number + self.motion.max_gap_photos)][1]
            follow_N = self.gain_N[end:] + weight_N[end:]
            near_MK = follow_N[: last - end, None] + self.flown(slice(end, last), slice(begin, end))
            far_1K = np.full((1, end - begin), _combine_all(_logsum, follow_N[last - end :]))
            weight_N[begin:end] = _logsum(
                np.concatenate([near_MK, far_1K, np.zeros((1, end - begin))])
            )
        return weight_N

    def backtrace(self, best_N: Doubles, predecessor_N: Ints) -> list[int | None]:
        """For each photo the number of its candidate in the best chain."""
        chosen: list[int | None] = [None] * len(self.spans)
        at = int(best_N.argmax()) if len(best_N) and best_N.max() > 0 else -1
        for number in range(len(self.spans) - 1, -1, -1):
            begin, end = self.spans[number]
            if begin <= at < end:
                chosen[number] = at - begin
                at = int(predecessor_N[at])
        return chosen


def _within_reach(some_M3: Doubles, others_K3: Doubles, way_MK: Doubles) -> npt.NDArray[np.bool_]:
    """Whether great circles between points are at most that long; by their chords, which a matrix
    product gives.
    """
    squared_MK = 2 * (EARTH_RADIUS_M**2 - some_M3 @ others_K3.T)
    chord_MK = 2 * EARTH_RADIUS_M * np.sin(np.minimum(way_MK / (2 * EARTH_RADIUS_M), np.pi / 2))
    return np.asarray(squared_MK <= chord_MK**2 + 1.0)  # a metre's square: the product's rounding


def _combine_all(combine: Combine, weight_M: Doubles) -> float:
    """All of them as one; -inf of none."""
    return float(combine(weight_M[:, None])[0]) if len(weight_M) else -math.inf


def _logsum(x_MK: Doubles) -> Doubles:
    """Log of the sum of exponentials down the rows; -inf where all are."""
    top_K = x_MK.max(axis=0)
    top_K = np.where(np.isfinite(top_K), top_K, 0)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.exp(x_MK - top_K).sum(axis=0)) + top_K)
