"""Heights of the ground, roofs and trees around a position, of a surface model in any coordinate
system.

Shapes: H, W pixels, the first row the northern one.
"""

import numpy as np
import rasterio
from rasterio.enums import Resampling
from rasterio.transform import Affine
from rasterio.warp import reproject

from pipeline.camera.local_plane import LocalPlane
from pipeline.core.arrays import Floats
from pipeline.sources.maps.mosaic import open_mosaic


def read_heights(path: str, plane: LocalPlane, side_px: int, metres_per_pixel: float) -> Floats:
    """Metres (H, W) above the model's own zero in a north-up square around the plane's zero; NaN
    where the model has none. Raises rasterio's errors for a file that cannot be read."""
    reach_m = side_px / 2 * metres_per_pixel
    local = f"+proj=aeqd +lat_0={plane.lat:.9f} +lon_0={plane.lon:.9f} +datum=WGS84 +units=m"
    heights_HW = np.full((side_px, side_px), np.nan, np.float32)
    reproject(
        source=rasterio.band(open_mosaic(path), 1), destination=heights_HW, dst_crs=local,
        dst_transform=Affine(metres_per_pixel, 0, -reach_m, 0, -metres_per_pixel, reach_m),
        dst_nodata=np.nan, resampling=Resampling.bilinear,
    )  # fmt: skip
    return heights_HW
