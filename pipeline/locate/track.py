"""A flight's photos in time order -> its track: uncertain photos are decided by their neighbours.

In: for each photo its candidates with the probability of each, and of none, from the photo alone.
Out: the most probable path that a UAV can fly through the candidates, and for each photo the
probability of its candidates given all photos. A photo may show none of its candidates: the path
then skips it, and the motion limit holds between the photos before and after. Exact: the Viterbi
and the forward-backward recursions weigh all paths. NumPy only, no I/O. Shapes: K candidates of one
photo, N candidates of all photos in time order, M of the photos before one, 2 = latitude and
longitude in degrees, 3 = metres from the earth's centre.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Doubles, Ints, Mask
from pipeline.core.errors import require
from pipeline.core.geo import EARTH_RADIUS_M, on_sphere

TRACK_CANDIDATES = 30
"""Candidates of a photo that the track may pass through. More than decide on a single answer: the
flight tells them apart, and the track cannot choose a location that the search did not return."""

Combine = Callable[[Doubles], Doubles]
"Reduces log-weights (M, K) over their rows: by the maximum (Viterbi) or by log-sum-exp (forward)."


@dataclass(frozen=True, kw_only=True)
class Motion:
    """The motion model: how far a UAV may fly between photos."""

    max_speed: float = 25.0
    "Metres per second over the ground; 25 is beyond most multicopters, fixed wings fly faster."
    slack_m: float = 0.0
    """Metres added to every distance: how far a photo may lie from the position of its gallery
    image, at both ends."""
    gallery_positions: float = 1.0
    "Positions in the gallery; the photo's own probabilities assume any of them."
    spacing_m: float = math.inf
    "Spacing of the gallery: each position stands for a square of this side."
    elsewhere: float = 0.1
    "Share of the photos that are expected to show no location of the gallery."
    max_gap_photos: int = 60
    """Photos over which the limit holds: across a longer gap the UAV may have come from anywhere,
    and mostly could have. It bounds the time that a long flight takes."""

    def __post_init__(self) -> None:
        require(self.max_speed > 0, "max_speed", self.max_speed, "metres per second above 0")
        share = "a share above 0 and below 1"
        require(0 < self.elsewhere < 1, "elsewhere", self.elsewhere, share)

    def gain(self, reach_m: Doubles) -> Doubles:
        """Log of how much likelier a candidate is for lying within `reach_m` metres of the previous
        one: the gallery's positions over those within reach, at least 1. The photo's own
        probabilities assume that it may be anywhere in the gallery."""
        within = np.pi * (reach_m / self.spacing_m) ** 2
        ratio = self.gallery_positions / np.maximum(within, 1.0)
        return np.asarray(np.log(np.maximum(ratio, 1.0)))


@dataclass(frozen=True, kw_only=True)
class TrackPhoto:
    """One photo of the flight with its candidates."""

    time_s: float
    "Seconds since any moment."
    positions_K2: Doubles
    "Latitude and longitude of the candidates; one with NaN (unknown) is never chosen."
    log_p_K: Doubles
    "Log-probability of each candidate, from the photo alone."
    log_p_none: float
    "Log-probability of none of them."


@dataclass(frozen=True, kw_only=True)
class TrackStart:
    """The rough position at the first photo's time."""

    lat: float
    lon: float
    radius_m: float


@dataclass(frozen=True, kw_only=True)
class SmoothedPhoto:
    """The result for one photo, given all photos of the flight."""

    chosen: int | None
    "Number of the candidate on the most probable path; None where the path skips this photo."
    probability: float
    "Probability of `chosen`, given the whole flight."
    p_K: Doubles
    "Probability of each candidate, given the whole flight."


def smooth_track(
    photos: Sequence[TrackPhoto], motion: Motion, start: TrackStart | None = None
) -> list[SmoothedPhoto]:
    """The most probable track through photos that are in time order.

    The weight of a path is the product of its photos' probabilities and of the gains of the
    distances between them; a path faster than the motion model allows has weight 0. The time is
    proportional to the pairs of candidates within `max_gap_photos` photos.
    """
    if not photos:
        return []
    trellis = _Trellis.of(photos, start, motion)
    best_N, predecessor_N = trellis.forward(lambda x_MK: x_MK.max(axis=0), trace=True)
    chosen = trellis.backtrace(best_N, predecessor_N)
    before_N, _ = trellis.forward(_logsumexp)
    after_N = trellis.backward()
    total = _logsumexp(np.concatenate([[0.0], before_N])[:, None])[0]
    p_N = np.exp(np.minimum(before_N + after_N - total, 0))
    smoothed = []
    for (begin, end), number in zip(trellis.spans, chosen, strict=True):
        p_K = p_N[begin:end]
        probability = max(0.0, 1 - p_K.sum()) if number is None else p_K[number]
        smoothed.append(SmoothedPhoto(chosen=number, probability=float(probability), p_K=p_K))
    return smoothed


@dataclass(frozen=True, kw_only=True)
class _Trellis:
    """The candidates of all photos in one row, with log-weights. Weights are relative to that of
    the path that skips all photos; so a skipped photo costs nothing, and a candidate gains its
    probability over that of none."""

    point_N3: Doubles
    time_N: Doubles
    gain_N: Doubles
    start_gain_N: Doubles
    "Gain of a path that begins at a candidate; -inf beyond the reach of the rough start."
    spans: tuple[tuple[int, int], ...]
    "Where each photo's candidates begin and end."
    motion: Motion

    @staticmethod
    def of(photos: Sequence[TrackPhoto], start: TrackStart | None, motion: Motion) -> "_Trellis":
        counts = [len(photo.log_p_K) for photo in photos]
        ends = np.cumsum(counts).tolist()
        position_N2 = np.concatenate([photo.positions_K2.reshape(-1, 2) for photo in photos])
        gain_N = np.concatenate([photo.log_p_K - photo.log_p_none for photo in photos])
        point_N3 = on_sphere(np.nan_to_num(position_N2))
        time_N = np.repeat([photo.time_s for photo in photos], counts)
        start_gain_N = np.zeros(len(gain_N))
        if start:
            start_13 = on_sphere(np.array([[start.lat, start.lon]]))
            flown_N = motion.max_speed * (time_N - photos[0].time_s)
            reach_N = start.radius_m + motion.slack_m + flown_N
            within_N = _within_reach(start_13, point_N3, reach_N[None])[0]
            start_gain_N = np.where(within_N, motion.gain(reach_N), -np.inf)
        return _Trellis(
            point_N3=point_N3,
            time_N=time_N,
            gain_N=np.where(np.isnan(position_N2).any(axis=1), -np.inf, gain_N),
            start_gain_N=start_gain_N,
            spans=tuple(zip([0, *ends[:-1]], ends, strict=True)),
            motion=motion,
        )

    def transition(self, some: slice, others: slice) -> Doubles:
        """Gain (M, K) of flying from some candidates (M) to others (K); -inf out of reach."""
        seconds_MK = np.abs(self.time_N[others][None] - self.time_N[some][:, None])
        reach_MK = self.motion.max_speed * seconds_MK + self.motion.slack_m
        within_MK = _within_reach(self.point_N3[some], self.point_N3[others], reach_MK)
        return np.where(within_MK, self.motion.gain(reach_MK), -np.inf)

    def forward(self, combine: Combine, trace: bool = False) -> tuple[Doubles, Ints]:
        """Log-weight of the paths that end in each candidate, and for `trace` the candidate before
        it (-1: none)."""
        weight_N = np.full(len(self.gain_N), -np.inf)
        predecessor_N = np.full(len(self.gain_N), -1)
        for number, (begin, end) in enumerate(self.spans):
            first = self.spans[max(0, number - self.motion.max_gap_photos)][0]
            moves_MK = self.transition(slice(first, begin), slice(begin, end))
            near_MK = weight_N[first:begin, None] + moves_MK
            far_1K = np.full((1, end - begin), _combine_all(combine, weight_N[:first]))
            # The last row is the path that begins here.
            to_MK = np.concatenate([near_MK, far_1K, self.start_gain_N[None, begin:end]])
            weight_N[begin:end] = self.gain_N[begin:end] + combine(to_MK)
            if trace and end > begin:
                last_K = first + to_MK.argmax(axis=0)
                far = int(weight_N[:first].argmax()) if first else -1
                before_K = np.where(last_K == begin, far, -1)
                predecessor_N[begin:end] = np.where(last_K < begin, last_K, before_K)
        return weight_N, predecessor_N

    def backward(self) -> Doubles:
        """Log-weight of the continuations of each candidate, the empty one included."""
        weight_N = np.zeros(len(self.gain_N))
        for number in range(len(self.spans) - 1, -1, -1):
            begin, end = self.spans[number]
            last_number = min(len(self.spans) - 1, number + self.motion.max_gap_photos)
            last = self.spans[last_number][1]
            follow_N = self.gain_N[end:] + weight_N[end:]
            moves_MK = self.transition(slice(end, last), slice(begin, end))
            near_MK = follow_N[: last - end, None] + moves_MK
            far_1K = np.full((1, end - begin), _combine_all(_logsumexp, follow_N[last - end :]))
            to_MK = np.concatenate([near_MK, far_1K, np.zeros((1, end - begin))])
            weight_N[begin:end] = _logsumexp(to_MK)
        return weight_N

    def backtrace(self, best_N: Doubles, predecessor_N: Ints) -> list[int | None]:
        """For each photo the number of its candidate on the best path."""
        chosen: list[int | None] = [None] * len(self.spans)
        at = int(best_N.argmax()) if len(best_N) and best_N.max() > 0 else -1
        for number in range(len(self.spans) - 1, -1, -1):
            begin, end = self.spans[number]
            if begin <= at < end:
                chosen[number] = at - begin
                at = int(predecessor_N[at])
        return chosen


def _within_reach(some_M3: Doubles, others_K3: Doubles, reach_MK: Doubles) -> Mask:
    """Whether great circles between points are at most that long; by their chords, which a matrix
    product gives."""
    squared_MK = 2 * (EARTH_RADIUS_M**2 - some_M3 @ others_K3.T)
    half_angle_MK = np.minimum(reach_MK / (2 * EARTH_RADIUS_M), np.pi / 2)
    chord_MK = 2 * EARTH_RADIUS_M * np.sin(half_angle_MK)
    return np.asarray(squared_MK <= chord_MK**2 + 1.0)  # 1 square metre: the product's rounding


def _combine_all(combine: Combine, weight_M: Doubles) -> float:
    """All weights combined into one; -inf where there are none."""
    return float(combine(weight_M[:, None])[0]) if len(weight_M) else -math.inf


def _logsumexp(x_MK: Doubles) -> Doubles:
    """Log of the sum of exponentials down the rows; -inf where all are."""
    top_K = x_MK.max(axis=0)
    top_K = np.where(np.isfinite(top_K), top_K, 0)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.exp(x_MK - top_K).sum(axis=0)) + top_K)
