"""The poses of a simulated flight over a map: of random places, on a survey, or on a spiral.

In: the flight's settings, and a random generator or a photo's number. Out: poses that look at
(0, 0), the place of the photos, and for a survey the place too.
"""

import math

import numpy as np

from pipeline.camera.ground import apply_homography, corners, photo_to_ground
from pipeline.camera.local_plane import LocalPlane
from pipeline.camera.pose import Pose
from pipeline.simulation.flight import LOWEST_RAY_DEG, FlightPlan
from pipeline.simulation.over_map.settings import MapFlightSettings
from pipeline.simulation.over_map.survey import survey_point
from pipeline.sources.maps.mosaic import open_mosaic
from pipeline.sources.maps.placement import Placement

MARGIN_M = 12.0
"Ground beyond the photo's corners."


def draw_poses(settings: MapFlightSettings, rng: np.random.Generator, count: int) -> list[Pose]:
    """`count` poses, each drawn independently and uniformly within the settings' ranges; see
    `_draw_fov`."""
    return [_draw_pose(settings, rng) for _ in range(count)]


def spiral_poses(settings: MapFlightSettings, rng: np.random.Generator) -> list[Pose]:
    """The poses of a spiral, one for each photo of the flight: University-1652's three turns in
    steps of equal angles, from the upper end of the heights down to the lower one.

    The UAV circles at the distance from which its lowest photo has the flattest pitch, and further
    out where it would look down more steeply than the steepest. The first heading and the lens,
    one for all photos, are drawn.
    """
    (low_m, high_m), (steepest, flattest) = settings.height, settings.pitch
    fov = _draw_fov(settings, rng, flattest)
    first = float(rng.uniform(0, 360))
    poses = []
    for number in range(settings.photos):
        height_m = high_m - (high_m - low_m) * number / max(1, settings.photos - 1)
        away_m = max(
            low_m / math.tan(math.radians(-flattest)), height_m / math.tan(math.radians(-steepest))
        )
        turned = 360 * FlightPlan.turns * number / settings.photos
        poses.append(
            Pose.looking_at_zero(
                altitude_m=height_m, heading_deg=(first + turned) % 360,
                pitch_deg=-math.degrees(math.atan2(height_m, away_m)), fov_deg=fov,
            )
        )  # fmt: skip
    return poses


def survey_pose(
    settings: MapFlightSettings, placement: Placement, number: int
) -> tuple[list[Pose], tuple[float, float]]:
    """The pose of a survey's photo, and the map's pixel in its middle. Its camera is that of the
    whole flight.

    Raises InputError where the map is too small.
    """
    drawn = _draw_pose(settings, np.random.default_rng(settings.seed))
    look = {"altitude_m": drawn.altitude_m, "pitch_deg": drawn.pitch_deg, "fov_deg": drawn.fov_deg}
    ahead_m, dataset = math.hypot(drawn.x_m, drawn.y_m), open_mosaic(settings.mosaic)
    reach = reach_m(Pose.looking_at_zero(heading_deg=0.0, **look))
    across_m, down_m = placement.pixel_m
    x_m, y_m, direction_deg = survey_point(
        number, settings.every_m, settings.line_m,
        (dataset.width * across_m, dataset.height * down_m), ahead_m + reach,
    )  # fmt: skip
    right, up = math.sin(math.radians(direction_deg)), math.cos(math.radians(direction_deg))
    here = x_m / across_m, y_m / down_m
    middle = here[0] + ahead_m * right / across_m, here[1] - ahead_m * up / down_m
    # The map's upper side need not be north.
    further = middle[0] + 9 * right / across_m, middle[1] - 9 * up / down_m
    degrees_22 = placement.georeference.degrees(np.array([middle, further]))
    plane = LocalPlane(lat=float(degrees_22[0, 0]), lon=float(degrees_22[0, 1]))
    [[east, north]] = plane.to_metres(degrees_22[1:]).tolist()
    heading_deg = math.degrees(math.atan2(east, north)) % 360
    return [Pose.looking_at_zero(heading_deg=heading_deg, **look)], middle


def reach_m(pose: Pose) -> float:
    """Half the side of the square of ground that a photo shows, around (0, 0)."""
    size = (100, 100)
    shown_42 = apply_homography(photo_to_ground(pose, size), corners(size))
    return float(np.abs(shown_42).max()) + MARGIN_M


def _draw_pose(settings: MapFlightSettings, rng: np.random.Generator) -> Pose:
    pitch = float(rng.uniform(*settings.pitch))
    fov = _draw_fov(settings, rng, pitch)
    height = float(rng.uniform(*settings.height))
    heading = float(rng.uniform(0, 360))
    return Pose.looking_at_zero(
        altitude_m=height, heading_deg=heading, pitch_deg=pitch, fov_deg=fov
    )


def _draw_fov(settings: MapFlightSettings, rng: np.random.Generator, pitch_deg: float) -> float:
    """A field of view within the settings' range, narrowed where its lowest ray would be flatter
    than LOWEST_RAY_DEG."""
    return min(float(rng.uniform(*settings.fov_range)), 2 * (-pitch_deg - LOWEST_RAY_DEG))
