"""The settings of encoding: flags of jobs/embed_gallery.py.

Imports nothing heavy, so that the command line is parsed at once.
"""

from dataclasses import dataclass
from typing import Literal

from model.inference.precision import Precision
from pipeline.camera.pose import Perspective
from pipeline.images.transforms import Resizer

Compiling = Literal["auto", "always", "never"]


@dataclass(frozen=True, kw_only=True)
class EncoderSettings:
    """How images become embeddings. All but `compiling` is part of the fingerprint."""

    mirror: bool | None = None
    """Whether the embeddings of an image and its mirror image are summed [LPN]; by default where
    the encoder was trained on mirrored images."""
    resizer: Resizer = "torch"
    """Whose bicubic resizes the images: torch's, or pillow's, which is faster on CPUs without AVX2;
    tables do not mix."""
    perspective: Perspective | None = None
    """How UAV images are seen: as they were taken, or laid on the ground north up where the shards
    have the camera's pose; by default as the encoder was trained."""
    precision: Precision = "auto"
    """float32; bfloat16; int8, for CPUs that multiply 8-bit integers fast, calibrated by images of
    the shards; auto: that of a table to go on with, else bfloat16 on GPUs, int8 for thousands of
    images by the built-in encoder on such CPUs, else float32."""
    compiling: Compiling = "auto"
    """Whether the encoder is compiled, on CPUs by OpenVINO (int8 always), on GPUs by torch; auto:
    where that saves more time than it takes."""
