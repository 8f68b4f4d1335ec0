"""The criteria of a calibration, and how a flight is located. Imports nothing heavy: the command
line is parsed at once."""

from dataclasses import dataclass

from pipeline.core.errors import InputError, require


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


@dataclass(frozen=True, kw_only=True)
class FlightSettings:
    """Whether photos are of one flight, and what is known of it."""

    track: bool = False
    """The photos are of one flight: each is located given all of them, and the GeoJSON begins with
    the flight's line."""
    online: bool = False
    """With --track: locate each photo by the photos up to it only, as in flight; without it, by all
    photos of the flight."""
    max_speed: float = 25.0
    "Of the flight, metres per second over the ground; 25 is beyond most multicopters."
    elsewhere: float = 0.1
    "Of the flight, the share of photos expected to show no location of the gallery."
    times: str | None = None
    """CSV table with the columns photo and time (seconds or ISO 8601); by default the times in the
    camera's tags."""
    interval: float | None = None
    "Seconds between photos in the order of their names, where neither tables nor tags have times."
    odometry: str | None = None
    """With --track: CSV table with the columns photo, east_m, north_m and error_m, in the order of
    time: how far the camera has moved since the photo before, and the standard deviation of either
    part, metres. Rows may be missing or empty; photos that are not located may have rows."""

    def __post_init__(self) -> None:
        for flag, given in (("--online", self.online), ("--odometry", self.odometry is not None)):
            if given and not self.track:
                raise InputError(
                    f"found {flag} without --track, expected both: it is about the photos of one "
                    f"flight; add --track, or leave {flag} out"
                )
        positive = self.interval is None or self.interval > 0
        require(positive, "interval", self.interval, "seconds above 0")
        require(self.max_speed > 0, "max_speed", self.max_speed, "metres per second above 0")
        share = "a share above 0 and below 1"
        require(0 < self.elsewhere < 1, "elsewhere", self.elsewhere, share)
