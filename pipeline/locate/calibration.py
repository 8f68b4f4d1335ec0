"""How sure an answer is: what its candidates look like -> the probability that it is right.

In: what the candidates of a photo agree on. Out: a probability, by a small logistic model that
`pipeline/locate/calibrate.py` fits and `calibration.json` beside an index holds. It is of one
network and one gallery: another network's is refused. Shapes: K candidates, F features.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pipeline.core import json_files, storage
from pipeline.core.arrays import Doubles
from pipeline.core.errors import InputError
from pipeline.core.json_files import from_json
from pipeline.locate.consensus import Consensus
from pipeline.locate.logistic import LogisticModel
from pipeline.locate.reliability import ReliabilityBin

SCHEMA_VERSION = 2
CALIBRATION_FILE = "calibration.json"
FEATURE_NAMES = ("score", "margin", "depth", "share")


def confidence_features(agreed: Consensus, scores_K: Doubles) -> Doubles:
    """What tells right from wrong answers (F,): the place's best score, by how much it beats the
    best candidate elsewhere, by how much it beats the mean of the candidates, and which share of
    them lies at the place."""
    best = float(scores_K[agreed.leader])
    return np.array(
        [best, best - agreed.elsewhere, best - scores_K.mean(), agreed.members_K.mean()]
    )


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A calibration of one network over one gallery."""

    fingerprint: str
    "Of the network and its preprocessing."
    gallery: int
    "Rows of the index."
    asked: str
    "Which photos it was fitted on, in words."
    spacing_m: float | None
    "Median distance of a gallery position to the next one; None where no two are known."
    agreement_radius_m: float
    """How far apart candidates may lie that agree on a place: what served the calibration's photos
    best."""
    tolerance_m: float
    """An answer was taken for right where it names the photo's location, or lies this near to its
    position."""
    outside: float
    "Share of photos that were supposed to show no place of the gallery."
    model: LogisticModel
    threshold: float
    """Below it an answer is `unknown`: where the share of right answers kept less that of others
    kept is greatest."""
    inverse_temperature: float
    "Of the track's choice among candidates: log-odds per unit of score."
    elsewhere: float
    """Of the track's choice: the log-odds of none of the candidates, at the level of the last one
    considered."""
    photos: int
    "That it was fitted on."
    locations: int
    "That they show."
    right: float
    "Share of these photos whose answer was right, their place being in the gallery."
    right_kept: float
    """Share of the right answers that the threshold keeps; this and what follows by folds of
    locations left out of the fit."""
    outside_unknown: float
    "Share of the photos without their place that it answers `unknown`."
    calibration_error: float
    "Expected calibration error."
    bins: tuple[ReliabilityBin, ...]
    "The reliability diagram's."

    def probability(self, agreed: Consensus, scores_K: Doubles) -> float:
        """That the place is right, by the candidates considered."""
        return float(self.model.probabilities(confidence_features(agreed, scores_K)[None])[0])


def write_calibration(path: str, confidence: Calibration) -> None:
    """The calibration as a JSON file, whole or not at all."""
    json_files.write_checksummed(
        path, {"schema_version": SCHEMA_VERSION, "features": FEATURE_NAMES, **asdict(confidence)}
    )


def read_calibration(path: str, facts: dict[str, Any]) -> Calibration:
    """The calibration of an index that says `facts` of itself.

    Raises InputError when the file is none, or another network's.
    """
    try:
        said = json_files.read_checksummed(path)
        if (
            said.pop("schema_version") != SCHEMA_VERSION
            or tuple(said.pop("features")) != FEATURE_NAMES
        ):
            raise ValueError("another version")
        confidence = from_json(Calibration, said)
        model = confidence.model
        if any(
            len(each) != len(FEATURE_NAMES)
            for each in (model.mean_F, model.scale_F, model.coefficient_F)
        ):
            raise ValueError("another number of features")
        if not np.isfinite(
            [
                *model.mean_F,
                *model.scale_F,
                *model.coefficient_F,
                model.intercept,
                confidence.threshold,
            ]
        ).all():
            raise ValueError("numbers that are none")
        if not all(model.scale_F):
            raise ValueError("a scale of 0")
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise InputError(
            f"{path} is not a calibration of schema {SCHEMA_VERSION} ({error!r}); expected what "
            "jobs/calibrate.py writes; delete it and calibrate again"
        ) from None
    if confidence.fingerprint != facts["fingerprint"]:
        raise InputError(
            f"{path} was made with network {confidence.fingerprint[:12]} and the index with {facts['fingerprint'][:12]}, "
            "expected the same; calibrate again with jobs/calibrate.py"
        )
    return confidence


def find_calibration(index: str, facts: dict[str, Any]) -> Calibration | None:
    """The calibration beside an index, if there is one. Raises InputError when it is another
    network's.
    """
    path = storage.join(index, CALIBRATION_FILE)
    return read_calibration(path, facts) if storage.exists(path) else None
