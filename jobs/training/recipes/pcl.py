"""PCL (Tian, TCSVT 2021), of which no code is public: a run in its style.

Known, from the abstract: UAV images are warped to a vertical view by a perspective projection; a
conditional GAN brings them nearer to satellite images; LPN localises on what it made. Not known:
the four points of the warp, and all of the GAN. Chosen here: the warp by the pose that the shards
carry, north up, as wide as the ground that the image's middle row shows; LPN's own rates. On the
shards that `jobs/translate.py` wrote, whose UAV images its GAN has made, these are all three
stages; on any other shards the warp and LPN, without the GAN. Never to be reported as a
reproduction.
"""

from dataclasses import replace

from jobs.training.recipes.lpn import lpn
from jobs.training.recipes.recipe import Recipe


def pcl_style() -> Recipe:
    """In the style of PCL at 256 px: LPN on UAV images laid on the ground by their pose."""
    return replace(lpn(), name="pcl_style", perspective="overhead")
