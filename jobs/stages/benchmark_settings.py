"""The settings of the benchmark of methods. Imports nothing heavy, so that the command line is
parsed at once."""

from dataclasses import dataclass

from jobs.training.recipes import RECIPES
from pipeline.core.errors import InputError, require

METHODS = (
    "alpha_zero", "paper", "constant_alpha", "no_restart", "instance_loss", "lpn", "pcl_style",
    "msba_style", "fsra", "mccg", "sample4geo", "dac", "camp", "qdfl", "usam", "usam_lpn", "best",
)  # fmt: skip
"""The control first: differences are to it. A row at published sizes only: LCM, which differs from
`instance_loss` in augmentation and epochs."""


@dataclass(frozen=True, kw_only=True)
class BenchmarkSettings:
    """Which methods are compared, on what data, at what cost."""

    out: str = "runs/benchmark"
    "Folder or URI for all of its outputs."
    shards: str | None = None
    "A packed data set, such as University-1652; by default one is simulated (SimU)."
    textures: str | None = None
    "Folder of real overhead images that SimU flies over, beside towns; by default towns alone."
    methods: tuple[str, ...] = METHODS
    "Recipes to compare; the first one is the baseline of all differences."
    seeds: int = 1
    "Trainings of each method, from seed 0 on."
    budget: int = 15_000
    "Images of both views that each training sees, in whole epochs."
    published_sizes: bool = False
    """Each method's own network, rates, batch and augmentation, and its whole schedule, in place of
    one backbone and an equal budget: days on a GPU."""
    train_locations: int = 300
    "Of SimU. University-1652: 701."
    test_locations: int = 100
    "Of SimU: places that are queried, never trained on. University-1652: 701."
    distractors: int = 100
    "Of SimU: places in the gallery only. University-1652: 250."
    views: int = 12
    "UAV images of a place of SimU. University-1652: 54."
    size: int = 128
    "Side of SimU's images in pixels. University-1652: 512."

    def __post_init__(self) -> None:
        for name in ("seeds", "budget"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        unknown = [name for name in self.methods if name not in RECIPES]
        if unknown or len(set(self.methods)) < max(2, len(self.methods)):
            raise InputError(
                f"--methods is {' '.join(self.methods) or 'empty'}, expected two or more different "
                f"ones of: {', '.join(RECIPES)}"
            )
