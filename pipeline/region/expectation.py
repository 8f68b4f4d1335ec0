"""Answers of photos whose truth is known -> what one can expect of photos like them.

In: one `Outcome` per photo. Out: shares with intervals, by what was known of the camera, by height
and by pitch. No I/O.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

WITHIN_M = (1.0, 5.0, 25.0)
"Distances that shares are stated for, metres."
PRECISION = 0.95
"Of answers: the share of photos that is answered so is their coverage."
WRONG_M = 25.0
"An answer that is farther off is wrong."
NORMAL_95 = 1.959964
GROUPS = 3
"Groups of equal size that photos are divided into, by height and by pitch."


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """A photo of a known place, and its answer."""

    name: str
    error_m: float
    "From the answered position to the ground that its middle shows; infinite without a position."
    known: bool
    "Whether the answer is given; else it is `unknown`."
    probability: float | None
    within_m: float | None
    "The probability is that of an error up to so many metres."
    refined: bool
    "Whether it was matched with the map's pixels."
    posed: bool
    "Whether the camera's tags were used."
    height_m: float
    pitch_deg: float


@dataclass(frozen=True, kw_only=True)
class Share:
    """A share of photos with its 95 % interval by Wilson's score."""

    value: float
    low: float
    high: float
    count: int
    "Photos that it is a share of."


@dataclass(frozen=True, kw_only=True)
class Expectation:
    """Figures of one group of photos."""

    title: str
    photos: int
    answered: Share
    within: tuple[Share, ...]
    "Shares of all photos that are answered within WITHIN_M, metres."
    wrong: Share
    "Share of the answers given that are more than WRONG_M off."
    median_m: float
    "Of the answers given; NaN where there are none."
    p90_m: float
    calibration_gap: float
    """The mean probability of the answers given, less the share of them that is right: above 0 they
    promise too much. NaN without probabilities."""


def share_of(yes: Sequence[bool]) -> Share:
    """The share of true values, with Wilson's interval (Wilson 1927); 0 to 1 of none."""
    count, right = len(yes), sum(yes)
    if not count:
        return Share(value=math.nan, low=0.0, high=1.0, count=0)
    z2, value = NORMAL_95**2, right / count
    middle = (value + z2 / (2 * count)) / (1 + z2 / count)
    spread = math.sqrt(value * (1 - value) / count + z2 / (4 * count**2)) * NORMAL_95
    half = spread / (1 + z2 / count)
    return Share(
        value=value, low=max(0.0, middle - half), high=min(1.0, middle + half), count=count
    )


def coverage(outcomes: Sequence[Outcome], precision: float, within_m: float) -> float:
    """The largest share of the photos that is answered by probabilities of a threshold and above,
    where at least `precision` of these answers are within `within_m` metres; 0 where no threshold
    does. Answers of the same probability are given together."""
    sure = sorted(
        (one for one in outcomes if one.known and one.probability is not None),
        key=lambda one: one.probability or 0.0,
        reverse=True,
    )
    best = right = 0
    for given, one in enumerate(sure, 1):
        right += one.error_m <= within_m
        tied = given < len(sure) and sure[given].probability == one.probability
        if not tied and right >= precision * given:
            best = given
    return best / len(outcomes) if outcomes else 0.0


def expect(title: str, outcomes: Sequence[Outcome]) -> Expectation:
    """The figures of some photos."""
    given = [one for one in outcomes if one.known]
    errors = np.array([one.error_m for one in given])
    sure = [one for one in given if one.probability is not None and one.within_m is not None]
    gap = math.nan
    if sure:
        promised = float(np.mean([one.probability for one in sure]))
        gap = promised - float(np.mean([one.error_m <= (one.within_m or 0) for one in sure]))
    return Expectation(
        title=title,
        photos=len(outcomes),
        answered=share_of([one.known for one in outcomes]),
        within=tuple(
            share_of([one.known and one.error_m <= metres for one in outcomes])
            for metres in WITHIN_M
        ),
        wrong=share_of([one.error_m > WRONG_M for one in given]),
        median_m=float(np.median(errors)) if given else math.nan,
        p90_m=float(np.quantile(errors, 0.9, method="higher")) if given else math.nan,
        calibration_gap=gap,
    )


def expectations(outcomes: Sequence[Outcome]) -> list[Expectation]:
    """The figures of all photos with and without their camera's tags, then by height and pitch."""
    found = []
    for posed, way in ((True, "with the camera's tags"), (False, "without them")):
        if group := [one for one in outcomes if one.posed == posed]:
            found.append(expect(way, group))
    heights = _in_groups(outcomes, lambda one: one.height_m)
    found += [expect(f"{_range(group, lambda o: o.height_m)} m high", group) for group in heights]
    pitches = _in_groups(outcomes, lambda one: one.pitch_deg)
    return found + [
        expect(f"pitch {_range(group, lambda o: o.pitch_deg)} degrees", group) for group in pitches
    ]


def _in_groups(
    outcomes: Sequence[Outcome], value: Callable[[Outcome], float]
) -> list[list[Outcome]]:
    ordered = sorted(outcomes, key=value)
    cuts = [round(number * len(ordered) / GROUPS) for number in range(GROUPS + 1)]
    groups = [ordered[begin:end] for begin, end in pairwise(cuts)]
    return [group for group in groups if group]


def _range(group: Sequence[Outcome], value: Callable[[Outcome], float]) -> str:
    return f"{value(group[0]):.0f} to {value(group[-1]):.0f}"


def read_expectations(rows: Sequence[dict[str, Any]]) -> list[Expectation]:
    """Expectations from their decoded JSON."""
    return [
        Expectation(
            **row
            | {name: Share(**row[name]) for name in ("answered", "wrong")}
            | {"within": tuple(Share(**share) for share in row["within"])}
        )
        for row in rows
    ]
