"""A flight's photos in time order -> its track: uncertain photos are decided by their neighbours.

In: for each photo its candidates with the probability of each, and of none, from the photo alone;
their errors and odometry, where known. Out: the most probable path that a UAV can fly through the
candidates, and the probability of each given all photos (`smooth_track`) or those up to its own
(`filter_track`). A photo may show none of its candidates: the path then skips it, and the motion
limit holds between the photos before and after. Exact: the Viterbi and the forward-backward
recursions weigh all paths. NumPy only, no I/O. Shapes: K candidates of one photo, N of all photos
in time order, M of the photos before one, 2 = latitude and longitude in degrees.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from pipeline.core.arrays import Doubles, Ints
from pipeline.core.errors import require
from pipeline.locate.movement import Ends, Places, moves_between
from pipeline.locate.odometry import Travelled

TRACK_CANDIDATES = 30
"""Candidates of a photo that the track may pass through. More than decide on a single answer: the
flight tells them apart, and the track cannot choose a location that the search did not return."""

Combine = Callable[[Doubles], Doubles]
"Reduces log-weights (M, K) over their rows: by the maximum (Viterbi) or by log-sum-exp (forward)."
_most: Combine = partial(np.max, axis=0)


@dataclass(frozen=True, kw_only=True)
class Motion:
    """The motion model: how far a UAV may fly between photos."""

    max_speed: float = 25.0
    "Metres per second over the ground; 25 is beyond most multicopters, fixed wings fly faster."
    slack_m: float = 0.0
    "Metres added to every reach, beside the errors of the candidates at its ends."
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

    def gains(self, some: Ends, others: Ends) -> Doubles:
        """Gain (M, K) of the moves between candidates. Where odometry measured the displacement:
        log of how much likelier it is for these candidates than for places anywhere in the gallery;
        else by the speed limit, -inf out of reach."""
        moves = moves_between(some, others, self.max_speed, self.slack_m)
        by_speed_MK = np.where(moves.within_MK, self.gain(moves.reach_MK), -np.inf)
        if not moves.measured_MK.any():
            return by_speed_MK
        if math.isfinite(self.spacing_m):
            area_m2 = max(self.gallery_positions, 1.0) * self.spacing_m**2
            measured_MK = math.log(area_m2) + moves.log_density_MK
        else:  # no area is known: as at the speed limit, where a single position is within reach
            most = math.log(max(self.gallery_positions, 1.0))
            measured_MK = most + moves.log_density_MK - moves.peak_MK
        return np.where(moves.measured_MK, measured_MK, by_speed_MK)


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
    ground: Places | None = None
    "The candidates' positions with their errors; None: they have no errors of their own."
    camera: Places | None = None
    "Where the camera is if a candidate is right, with errors; None, and NaN: unknown."
    ahead_m: float = 0.0
    "Metres from below the camera to the ground in the photo's middle, where only these are known."
    travelled: Travelled | None = None
    "The camera's way up to this photo, by odometry."


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
    best_N, predecessor_N = trellis.forward(_most, trace=True)
    chosen = trellis.backtrace(best_N, predecessor_N)
    before_N, _ = trellis.forward(_logsumexp)
    after_N = trellis.backward()
    total = _logsumexp(np.concatenate([[0.0], before_N])[:, None])[0]
    p_N = np.exp(np.minimum(before_N + after_N - total, 0))
    pairs = zip(trellis.spans, chosen, strict=True)
    return [_chosen(number, p_N[begin:end]) for (begin, end), number in pairs]


def filter_track(
    photos: Sequence[TrackPhoto], motion: Motion, start: TrackStart | None = None
) -> list[SmoothedPhoto]:
    """For each photo, by the photos up to it only: what can be known in flight.

    A candidate's probability is the share of the paths that end at it among all that end at this
    photo or before, the empty one included; `chosen` is the end of the most probable of them. For
    the last photo both are those of `smooth_track`.
    """
    if not photos:
        return []
    trellis = _Trellis.of(photos, start, motion)
    best_N, _ = trellis.forward(_most)
    before_N, _ = trellis.forward(_logsumexp)
    total_N = np.logaddexp.accumulate(np.concatenate([[0.0], before_N]))
    filtered = []
    for begin, end in trellis.spans:
        p_K = np.exp(np.minimum(before_N[begin:end] - total_N[end], 0))
        at = _best_end(best_N[:end])
        filtered.append(_chosen(at - begin if at >= begin else None, p_K))
    return filtered


def _chosen(number: int | None, p_K: Doubles) -> SmoothedPhoto:
    probability = max(0.0, 1 - p_K.sum()) if number is None else p_K[number]
    return SmoothedPhoto(chosen=number, probability=float(probability), p_K=p_K)


def _best_end(best_N: Doubles) -> int:
    """The candidate at which the best path ends; -1 where it skips all photos."""
    return int(best_N.argmax()) if len(best_N) and best_N.max() > 0 else -1


@dataclass(frozen=True, kw_only=True)
class _Trellis:
    """The candidates of all photos in one row, with log-weights. Weights are relative to that of
    the path that skips all photos; so a skipped photo costs nothing, and a candidate gains its
    probability over that of none."""

    ends: Ends
    gain_N: Doubles
    start_gain_N: Doubles
    "Gain of a path that begins at a candidate; -inf beyond the reach of the rough start."
    spans: tuple[tuple[int, int], ...]
    "Where each photo's candidates begin and end."
    motion: Motion

    @staticmethod
    def of(photos: Sequence[TrackPhoto], start: TrackStart | None, motion: Motion) -> "_Trellis":
        counts = [len(photo.log_p_K) for photo in photos]
        last = np.cumsum(counts).tolist()
        ends = _ends_of(photos, counts)
        gain_N = np.concatenate([photo.log_p_K - photo.log_p_none for photo in photos])
        start_gain_N = np.zeros(len(gain_N))
        if start:
            start_gain_N = motion.gains(_start_end(start, photos[0]), ends)[0]
        return _Trellis(
            ends=ends,
            gain_N=np.where(np.isnan(ends.ground_N2).any(axis=1), -np.inf, gain_N),
            start_gain_N=start_gain_N,
            spans=tuple(zip([0, *last[:-1]], last, strict=True)),
            motion=motion,
        )

    def transition(self, some: slice, others: slice) -> Doubles:
        """Gain (M, K) of flying from some candidates (M) to others (K); -inf out of reach."""
        return self.motion.gains(self.ends.part(some), self.ends.part(others))

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
        at = _best_end(best_N)
        for number in range(len(self.spans) - 1, -1, -1):
            begin, end = self.spans[number]
            if begin <= at < end:
                chosen[number] = at - begin
                at = int(predecessor_N[at])
        return chosen


def _ends_of(photos: Sequence[TrackPhoto], counts: Sequence[int]) -> Ends:
    """The candidates of all photos in one row."""
    return Ends.of(
        time_N=np.repeat([photo.time_s for photo in photos], counts),
        ground=Places.joined([one.ground or Places.exact(one.positions_K2) for one in photos]),
        camera=Places.joined([one.camera or Places.unknown(len(one.log_p_K)) for one in photos]),
        ahead_N=np.repeat([photo.ahead_m for photo in photos], counts),
        travelled=[one.travelled for one, n in zip(photos, counts, strict=True) for _ in range(n)],
    )


def _start_end(start: TrackStart, first: TrackPhoto) -> Ends:
    """The rough start as a candidate: all of its circle is as likely."""
    circle = Places(
        positions_N2=np.array([[start.lat, start.lon]]),
        slack_N=np.array([start.radius_m]),
        covariance_N22=(start.radius_m / 2) ** 2 * np.eye(2)[None],  # of a disc, either part
    )
    return Ends.of(
        time_N=np.array([first.time_s]),
        ground=circle,
        camera=circle,
        ahead_N=np.zeros(1),
        travelled=[first.travelled],
    )


def _combine_all(combine: Combine, weight_M: Doubles) -> float:
    """All weights combined into one; -inf where there are none."""
    return float(combine(weight_M[:, None])[0]) if len(weight_M) else -math.inf


def _logsumexp(x_MK: Doubles) -> Doubles:
    """Log of the sum of exponentials down the rows; -inf where all are."""
    top_K = x_MK.max(axis=0)
    top_K = np.where(np.isfinite(top_K), top_K, 0)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.exp(x_MK - top_K).sum(axis=0)) + top_K)
