"""How a UAV flies, by its photos' tags: ranges of height, pitch and lens for simulated photos.

In: photos, and the ranges that stand where tags are silent. Out: ranges.
"""

from collections.abc import Sequence

import numpy as np

from pipeline.camera.pose import PartialPose
from pipeline.core import storage
from pipeline.core.arrays import evenly_spaced
from pipeline.images.decode import DecodeError
from pipeline.images.inspect import inspect
from pipeline.locate.photo_files import read_photo_tags
from pipeline.matching.photo_pose import PoseSettings, pose_of_photo
from pipeline.simulation.over_map.settings import CameraRanges

QUANTILES = (0.05, 0.95)
"Of the tags' values: a photo on the ground before take-off sets nothing."
STEEPEST_DEG, FLATTEST_DEG = -90.0, -35.0
"Pitches that are simulated."
MOST_PHOTOS = 300
"That are read, evenly spaced."
Range = tuple[float, float]


def ranges_of_photos(photos: Sequence[str], otherwise: CameraRanges) -> CameraRanges:
    """The ranges of photos of one UAV; `otherwise` where their tags do not tell."""
    kept = evenly_spaced(len(photos), MOST_PHOTOS)
    poses = [pose for at in kept if (pose := _pose(photos[at])) is not None]
    pitches = [one.pitch_deg for one in poses if one.pitch_deg is not None]
    return CameraRanges(
        height=_range([one.height_m for one in poses if one.height_m], otherwise.height),
        pitch=_range(
            [pitch for pitch in pitches if STEEPEST_DEG <= pitch <= FLATTEST_DEG], otherwise.pitch
        ),
        fov=_range([one.fov_deg for one in poses if one.fov_deg], otherwise.fov_range),
    )


def _range(values: Sequence[float], otherwise: Range) -> Range:
    if not values:
        return otherwise
    low, high = np.quantile(values, QUANTILES).tolist()
    return low, high


def _pose(path: str) -> PartialPose | None:
    """What a photo's tags say of its camera; None where it cannot be decoded."""
    data = storage.read_bytes(path)
    try:
        size = inspect(data)
    except DecodeError:
        return None
    return pose_of_photo(read_photo_tags(data), size, PoseSettings())
