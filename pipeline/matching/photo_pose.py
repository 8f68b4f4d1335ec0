"""What is known of a photo's camera: its tags, completed or overruled by flags."""

from dataclasses import dataclass

from pipeline.camera.lens import field_of_view
from pipeline.camera.pose import PartialPose
from pipeline.core.errors import require
from pipeline.images.camera_tags import CameraTags


@dataclass(frozen=True, kw_only=True)
class PoseSettings:
    """How the camera's pose is known. Flags overrule the tags of all photos."""

    pose: bool = True
    """Use heading, pitch, height and focal length of the photos' tags; --no-pose locates without
    them."""
    fov: float | None = None
    "Field of view across a photo's width, degrees, where tags do not tell it."
    height: float | None = None
    "Height of the camera above the ground, metres."
    heading: float | None = None
    "Direction of the camera, degrees clockwise from north."
    pitch: float | None = None
    "Angle of the camera above the horizon, degrees: -90 looks straight down."

    def __post_init__(self) -> None:
        turned = self.heading is None or -360 <= self.heading <= 360
        require(turned, "heading", self.heading, "degrees from 0 to 360")
        angles = "degrees from 1 to 170"
        require(self.fov is None or 1 <= self.fov <= 170, "fov", self.fov, angles)
        require(self.height is None or self.height > 0, "height", self.height, "metres above 0")
        down = "degrees from -90 to below 0"
        require(self.pitch is None or -90 <= self.pitch < 0, "pitch", self.pitch, down)


def pose_of_photo(tags: CameraTags, size: tuple[int, int], settings: PoseSettings) -> PartialPose:
    """What tags and flags say of the camera of a photo of `size` (width, height)."""
    if not settings.pose:
        return PartialPose(fov_deg=settings.fov)
    fov = field_of_view(
        size,
        focal_px=tags.focal_px,
        focal_35mm=tags.focal_35mm,
        focal_mm=tags.focal_mm,
        model=tags.model,
    )
    height = settings.height if settings.height is not None else tags.height_m
    pitch = settings.pitch if settings.pitch is not None else tags.pitch_deg
    return PartialPose(
        heading_deg=settings.heading if settings.heading is not None else tags.heading_deg,
        pitch_deg=None if pitch is None or pitch >= 0 else pitch,
        height_m=None if height is None or height <= 0 else height,
        fov_deg=settings.fov if settings.fov is not None else fov,
        roll_deg=tags.roll_deg or 0.0,
    )
