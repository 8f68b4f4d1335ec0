"""The calibration of an index: candidates of a photo -> the probability that its answer is right.

In: the consensus of a photo's candidates. Out: a probability, by a small logistic model that
`pipeline/locate/fitting/` fits and that is stored in `calibration.json` beside an index. It belongs
to one encoder and one gallery: that of another encoder is refused.
Shapes: K candidates, F features.
"""

from dataclasses import asdict, dataclass

import numpy as np

from pipeline.confidence.logistic import LogisticModel
from pipeline.confidence.reliability import ReliabilityBin
from pipeline.core import json_files, storage
from pipeline.core.arrays import Doubles
from pipeline.core.errors import InputError
from pipeline.core.json_files import from_json
from pipeline.locate.consensus import Consensus
from pipeline.matching.gate import GATE_FEATURES, Gate, gate_features
from pipeline.matching.refine import Refinement

SCHEMA_VERSION = 3
CALIBRATION_FILE = "calibration.json"
FEATURE_NAMES = ("score", "margin", "depth", "share")


def confidence_features(consensus: Consensus, scores_K: Doubles) -> Doubles:
    """The features (F,) of FEATURE_NAMES that separate right answers from wrong ones: the best
    score of the group, its margin over the best candidate outside the group, its margin over the
    mean score, and the share of candidates that belong to the group."""
    best = float(scores_K[consensus.leader])
    margin = best - consensus.best_other_score
    return np.array([best, margin, best - scores_K.mean(), consensus.members_K.mean()])


@dataclass(frozen=True, kw_only=True)
class MatchingCalibration:
    """What matching with the map's pixels says of an answer. The figures are measured in
    cross-validation: each photo by models that were fitted without its location."""

    gate: Gate
    "Which refinements hold, and how probably they are right."
    tile_model: LogisticModel
    "Of the tiles' answers for the photos whose refinement does not hold, by FEATURE_NAMES."
    tile_threshold: float
    "Such answers below it are `unknown`."
    photos: int
    "Photos that it was fitted on, each as often as there were ways to frame it."
    refined: float
    "Share of them that were refined rightly."
    known: float
    "Share of them that were answered, refined or by a tile."
    known_right: float
    "Share of the answered ones that were right."
    outside_unknown: float
    "Share of the photos without their place in the gallery that are answered `unknown`."
    calibration_error: float
    "Expected calibration error."
    bins: tuple[ReliabilityBin, ...]
    "Bins of the reliability diagram."

    def place_probability(self, refinement: Refinement) -> float:
        """Probability that a refinement shows the right place, within the calibration's tolerance.
        Fitted on `photos`, it is never surer than a photo more and a wrong one would make it
        (Laplace's rule of succession): a track has to be able to contradict it."""
        least = 1 / (self.photos + 2)
        [place] = self.gate.place_model.probabilities(gate_features(refinement)[None]).tolist()
        return float(min(max(place, least), 1 - least))

    def share_within(self, refinement: Refinement) -> float:
        """Probability that a refinement is within the gate's distance, if it shows the right
        place."""
        return min(1.0, self.gate.probability(refinement) / self.place_probability(refinement))


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A calibration of one encoder over one gallery."""

    fingerprint: str
    "Fingerprint of the encoder and its preprocessing."
    gallery_rows: int
    "Rows of the index."
    photo_selection: str
    "Which photos it was fitted on, in words."
    spacing_m: float | None
    "Median distance of a gallery position to the next one; None where no two are known."
    finest_side_m: float | None = None
    "Side of the gallery's finest level, to which spacing and agreement radius belong."
    agreement_radius_m: float
    "How far apart agreeing candidates may lie, chosen by the photos of the calibration."
    tolerance_m: float
    """An answer counted as right if it named the photo's location, or lay this near to its
    position."""
    outside: float
    "Share of photos that were assumed to show no location of the gallery."
    model: LogisticModel
    threshold: float
    """Answers below it are `unknown`: the probability at which the share of right answers kept,
    less the share of wrong answers kept, is greatest."""
    inverse_temperature: float
    "For the choice of a track among candidates: log-odds per unit of score."
    none_log_odds: float
    """For the choice of a track: the log-odds of none of the candidates, relative to a candidate
    whose score is that of the last one considered."""
    photos: int
    "Photos that it was fitted on."
    locations: int
    "Locations that these photos show."
    accuracy: float
    "Share of these photos whose answer was right with their location in the gallery."
    right_kept: float
    """Share of the right answers that the threshold keeps. Measured, as are the three fields below,
    in cross-validation: each photo by a model that was fitted without its location."""
    outside_unknown: float
    "Share of the photos without their location in the gallery that are answered `unknown`."
    calibration_error: float
    "Expected calibration error."
    bins: tuple[ReliabilityBin, ...]
    "Bins of the reliability diagram."
    matching: MatchingCalibration | None = None
    "Of photos that are matched with the map; None where it was fitted without a map."

    def probability(self, consensus: Consensus, scores_K: Doubles) -> float:
        """Probability that the consensus is the photo's location."""
        return float(self.model.probabilities(confidence_features(consensus, scores_K)[None])[0])


def write_calibration(path: str, calibration: Calibration) -> None:
    """Write the calibration as a JSON file, atomically."""
    header = {"schema_version": SCHEMA_VERSION, "features": FEATURE_NAMES}
    json_files.write_checksummed(path, header | asdict(calibration))


def read_calibration(path: str, fingerprint: str) -> Calibration:
    """Read and validate the calibration of an index whose encoder has this fingerprint.

    Raises InputError when the file is not a calibration, or one of another encoder.
    """
    try:
        content = json_files.read_checksummed(path)
        version, names = content.pop("schema_version"), tuple(content.pop("features"))
        if version != SCHEMA_VERSION or names != FEATURE_NAMES:
            raise ValueError("another version")
        calibration = from_json(Calibration, content)
        _check_model(calibration)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise InputError(
            f"{path} is not a calibration of schema {SCHEMA_VERSION} ({error!r}); expected what "
            "jobs/calibrate.py writes; delete it and calibrate again"
        ) from None
    if calibration.fingerprint != fingerprint:
        raise InputError(
            f"{path} was made with encoder {calibration.fingerprint[:12]} and the index with "
            f"{fingerprint[:12]}, expected the same; calibrate again with "
            "jobs/calibrate.py"
        )
    return calibration


def _check_model(calibration: Calibration) -> None:
    """Raise ValueError where the numbers of its models cannot be computed with."""
    models: list[tuple[LogisticModel, tuple[str, ...]]] = [(calibration.model, FEATURE_NAMES)]
    if calibration.matching:
        models.append((calibration.matching.tile_model, FEATURE_NAMES))
        gate = calibration.matching.gate
        models += [(gate.model, GATE_FEATURES), (gate.place_model, GATE_FEATURES)]
    for model, names in models:
        vectors = (model.mean_F, model.scale_F, model.coefficient_F)
        if any(len(vector_F) != len(names) for vector_F in vectors):
            raise ValueError("another number of features")
        flat = [value for vector_F in vectors for value in vector_F]
        if not np.isfinite([*flat, model.intercept, calibration.threshold]).all():
            raise ValueError("numbers that are not finite")
        if not all(model.scale_F):
            raise ValueError("a scale of 0")


def find_calibration(index: str, fingerprint: str) -> Calibration | None:
    """The calibration beside an index; None where there is none.

    Raises InputError when it is not one, or one of another encoder.
    """
    path = storage.join(index, CALIBRATION_FILE)
    return read_calibration(path, fingerprint) if storage.exists(path) else None
