"""The criteria of a calibration. Imports nothing heavy: the command line is parsed at once."""

from dataclasses import dataclass

from pipeline.core.errors import require


@dataclass(frozen=True, kw_only=True)
class CalibrationCriteria:
    """What counts as a right answer, and which share of future photos has none."""

    tolerance: float = 25.0
    "Metres within which a position is right."
    within: float = 5.0
    "Likewise of a photo that was matched with the map."
    outside: float = 0.5
    """Share of future photos that show no location of the gallery; the probabilities depend on
    it."""

    def __post_init__(self) -> None:
        require(self.tolerance > 0, "tolerance", self.tolerance, "metres above 0")
        require(self.within > 0, "within", self.within, "metres above 0")
        require(0 < self.outside < 1, "outside", self.outside, "a share above 0 and below 1")
