"""The settings of embedding and importing: flags of jobs/embed_gallery.py and import_features.py.

Imports nothing heavy, so that the command line is parsed at once.
"""

from dataclasses import dataclass
from typing import Literal

from pipeline.core.errors import require
from pipeline.core.records import Split, View

ViewName = Literal["drone", "satellite", "street", "google"]


@dataclass(frozen=True, kw_only=True)
class EmbeddingSettings:
    """Which shards are embedded into which table, and how the work is spread."""

    shards: str
    "Folder or URI of the shards."
    out: str
    "Folder or URI of the feature table."
    split: Split | None = None
    "Only this split; of shards without a manifest, which other programs made, the split they are."
    view: View | None = None
    "Only this view; likewise."
    batch_size: int = 32
    "Images per forward pass."
    dtype: str = "float32"
    "Of the stored embeddings: float32, or float16 for half the space."
    workers: int | None = None
    """Actors of Ray; by default one per GPU, or where there is none one per eight CPU cores. 0:
    this process embeds, without Ray."""
    cpus_per_worker: int | None = None
    "CPU cores of an actor; by default as many as let all actors fit on the nodes that are up."
    gpus_per_worker: float | None = None
    "GPUs of an actor; by default 1 where the cluster has any, else 0."
    decode_threads: int | None = None
    """Decoding threads of an actor; by default its cores but one beside a GPU, else one per four
    cores."""
    patience: float = 600.0
    "Seconds to wait for the first actor to start, before giving up."
    verify: bool = False
    """Compare every byte of the shards, and of the parts that are done, with the checksums first:
    damaged parts are embedded again."""

    def __post_init__(self) -> None:
        require(self.batch_size >= 1, "batch_size", self.batch_size, "at least 1")
        require(self.dtype in ("float32", "float16"), "dtype", self.dtype, "float32 or float16")
        for name, least in (("workers", 0), ("cpus_per_worker", 1), ("decode_threads", 1)):
            value = getattr(self, name)
            require(value is None or value >= least, name, value, f"at least {least}")
        gpus = self.gpus_per_worker
        require(gpus is None or gpus >= 0, "gpus_per_worker", gpus, "0 or more")


@dataclass(frozen=True, kw_only=True)
class ImportSettings:
    """Features to import."""

    mat: str
    "The .mat file (MATLAB 5, as scipy.io.savemat writes it); a path or a URI."
    out: str
    "Folder for the tables: queries and gallery appear in it."
    query_view: ViewName = "drone"
    "View of the queries, where the file has no paths that name it."
    gallery_view: ViewName = "satellite"
    "View of the gallery, where the file has no paths that name it."
    stated: tuple[float, float] | None = None
    """R@1 and AP in percent that are stated for these features, such as 82.73 85.19: whether both
    can be true is told by arithmetic, where a query has one true match."""

    def __post_init__(self) -> None:
        for value in self.stated or ():
            require(0 <= value <= 100, "stated", value, "percent, from 0 to 100")
