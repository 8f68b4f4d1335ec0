"""How images became embeddings: the settings of an encoder beside its weights.

In: the settings of embedding. Out: a record that tables and indexes carry in their metadata, so
that photos are encoded as the gallery was without repeating any setting.
"""

import json
from dataclasses import asdict, dataclass
from typing import Literal

from pipeline.camera.pose import Perspective
from pipeline.core.json_files import from_json
from pipeline.images.transforms import Resizer


@dataclass(frozen=True, kw_only=True)
class EncodingConfig:
    """What an embedding depends on besides weights and network."""

    mirror: bool
    "Whether the embeddings of an image and of its mirror image are summed [LPN]."
    resizer: Resizer
    "Whose bicubic resizes the images."
    precision: Literal["float32", "bfloat16", "int8"]
    calibration: str | None = None
    "Digest of the images that calibrated int8; None in other precisions."
    perspective: Perspective = "as_taken"
    "How UAV images are seen before they are resized."


def encode_config(config: EncodingConfig | None) -> str:
    """The configuration as JSON; `null` for features that another program made."""
    return json.dumps(None if config is None else asdict(config))


def parse_config(text: str | bytes) -> EncodingConfig | None:
    """The inverse of `encode_config`. Raises ValueError."""
    value = json.loads(text)
    return None if value is None else from_json(EncodingConfig, value)
