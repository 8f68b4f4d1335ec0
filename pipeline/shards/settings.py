"""The settings of packing: flags of jobs/make_shards.py. Imports nothing heavy, so that the command
line is parsed at once."""

from dataclasses import dataclass
from typing import Literal

from pipeline.core.errors import InputError

Check = Literal["quick", "full"]
"How an image is judged: by its headers and its end, or by decoding it."


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
    """How images are judged: quick, by their headers and ends, or full, by decoding them: finds
    every damage and takes long."""
    extend: bool = False
    "Add the imagery to the finished set in `out`, as new tars."
    workers: int | None = None
    """Tars packed at once, each by a Ray task; None for as many as there are cores, 0 for one after
    the other in this process."""

    def __post_init__(self) -> None:
        if self.samples_per_shard < 1:
            raise InputError(
                f"--samples-per-shard is {self.samples_per_shard}, expected at least 1"
            )
        if self.megabytes_per_shard is not None and not self.megabytes_per_shard > 0:
            raise InputError(
                f"--megabytes-per-shard is {self.megabytes_per_shard}, expected more than 0"
            )
        if not 0 <= self.max_bad_fraction <= 1:
            raise InputError(
                f"--max-bad-fraction is {self.max_bad_fraction}, expected a fraction from 0 to 1"
            )
        if self.workers is not None and self.workers < 0:
            raise InputError(f"--workers is {self.workers}, expected 0 (this process) or more")
