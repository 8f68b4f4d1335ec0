"""The settings of packing: flags of jobs/make_shards.py. Imports nothing heavy, so that the command
line is parsed at once."""

from dataclasses import dataclass
from typing import Literal

from pipeline.core.errors import require

Check = Literal["quick", "full"]
"How an image is checked: by its headers and its end, or by decoding it."


@dataclass(frozen=True, kw_only=True)
class PackingSettings:
    """Which imagery becomes shards, and where."""

    root: str
    "Where the imagery is."
    out: str
    "Folder or URI for the shards."
    samples_per_shard: int = 1000
    "Images per tar at most."
    megabytes_per_shard: float | None = None
    "Megabytes (1e6 bytes) of images per tar at most; None for any number."
    max_bad_fraction: float = 0.01
    "Refused images over all images; above it the job stops."
    check: Check = "quick"
    """How images are checked: quick, by their headers and ends, or full, by decoding them: finds
    every damage and takes long."""
    extend: bool = False
    "Add the imagery to the finished set in `out`, as new tars."
    workers: int | None = None
    """Tars packed at once, each by a Ray task; None for as many as there are cores, or none
    where all is done before a Ray has started; 0 for one after the other in this process."""

    def __post_init__(self) -> None:
        samples, megabytes, bad = (
            self.samples_per_shard,
            self.megabytes_per_shard,
            self.max_bad_fraction,
        )
        require(samples >= 1, "samples_per_shard", samples, "at least 1")
        require(megabytes is None or megabytes > 0, "megabytes_per_shard", megabytes, "more than 0")
        require(0 <= bad <= 1, "max_bad_fraction", bad, "a fraction from 0 to 1")
        require(
            self.workers is None or self.workers >= 0,
            "workers",
            self.workers,
            "0 (this process) or more",
        )
