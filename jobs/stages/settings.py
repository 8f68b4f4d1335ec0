"""The settings of the jobs whose stage needs the network and the pipeline. Imports nothing heavy,
so that the command line is parsed at once."""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import tyro

from jobs.encoding.settings import EncoderSettings
from model.weights.builtin import BUILTIN
from pipeline.core.errors import InputError, require
from pipeline.core.geo import Circle
from pipeline.core.records import Split, View
from pipeline.features.settings import EmbeddingSettings
from pipeline.index.settings import IndexSettings
from pipeline.locate.settings import CalibrationCriteria, FlightSettings
from pipeline.matching.photo_pose import PoseSettings
from pipeline.service.settings import ServiceSettings
from pipeline.shards.settings import PackingSettings
from pipeline.simulation.over_map.settings import SURFACE_FLAG


@dataclass(frozen=True, kw_only=True)
class MakeShardsSettings(PackingSettings):
    """Which imagery becomes shards, and where; or what is done with a finished set."""

    root: str = ""
    "Where the imagery is; needed for packing."
    verify: bool = False
    "Check every tar, count and hash of the finished set in `out`, and pack nothing."
    export: str | None = None
    """File for the record table of the finished set in `out`: .parquet, or .geojson with a point
    for each image whose position is known; packs nothing."""


@dataclass(frozen=True, kw_only=True)
class EmbedSettings(EmbeddingSettings, EncoderSettings):
    """Which shards are embedded, by which network, into which table."""

    checkpoint: str = BUILTIN
    """The encoder: `builtin`, a last.pt of jobs/train.py, or what jobs/import_weights.py or
    jobs/export_weights.py wrote."""


@dataclass(frozen=True, kw_only=True)
class BuildIndexSettings(IndexSettings):
    """Which table is indexed, and how; or how a finished index is changed."""

    table: str = ""
    "Folder or URI of the feature table; not needed for --remove, and for --verify of an index."
    extend: bool = False
    "Add those parts of the table to the finished index that it does not contain yet."
    remove: tuple[str, ...] = ()
    "Locations to remove from the finished index."
    verify: bool = False
    """Check every byte of the finished index; with --table, of the table first and of an index that
    is already finished."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.extend and self.remove:
            raise InputError(
                "found --extend and --remove, expected one of them; run one after the other"
            )
        needed = not self.remove and not (self.verify and not self.extend)
        require(bool(self.table) or not needed, "table", self.table, "a folder of features")


CIRCLE_FLAG: Any = tyro.constructors.PrimitiveConstructorSpec(
    nargs=3,  # tyro's own reading of an optional tuple takes the photos behind it as well
    metavar="LAT LON METRES",
    instance_from_str=lambda words: Circle(
        lat=float(words[0]), lon=float(words[1]), radius_m=float(words[2])
    ),
    is_instance=lambda value: value is None or isinstance(value, Circle),
    str_from_instance=lambda value: (
        [str(value)] if value is None else [str(value.lat), str(value.lon), str(value.radius_m)]
    ),
)
"Syntax of a circle on the command line."


@dataclass(frozen=True, kw_only=True)
class LocateSettings(FlightSettings, PoseSettings):
    """Photos to locate, the index to search, and the files to write."""

    photos: tyro.conf.Positional[tuple[str, ...]]
    "Photos, or folders with photos below them; paths or URIs."
    checkpoint: str = BUILTIN
    "The encoder that the index was made with."
    index: str
    "Folder or URI of the index."
    out: str
    "The GeoJSON file with a point per photo."
    top: int = 5
    "Candidates to list for each photo."
    together: bool = False
    "All photos of a folder show one location: search for them as one, by their mean embedding."
    near: Annotated[Circle | None, CIRCLE_FLAG] = None
    """Search only gallery images in this circle. With --track: where the flight began, at the time
    of its first photo."""
    verify: bool = False
    """Check every byte of the index first, and of the parts of the feature table where it searches
    their vectors."""
    calibration: str | None = None
    "Output of jobs/calibrate.py; by default INDEX/calibration.json where it exists."
    csv: str | None = None
    "A CSV file with a row per photo."
    page: str | None = None
    "An HTML page with photos, candidates and a map, in one file that needs no connection."
    shards: str | None = None
    """The shards that the index was made of: photos are matched with their pixels, and the page
    shows them."""
    match: bool = True
    """Match each photo with the map's pixels around its candidates: its place within metres instead
    of a tile's middle. Takes --shards whose tiles know their corners, such as those of a GeoTIFF;
    --no-match answers with tiles."""
    surface: Annotated[str | None, SURFACE_FLAG] = None
    """A surface model of the map's ground (a GeoTIFF of heights): roofs and slopes are then placed
    where they stand. By default the one that jobs/adapt.py was given."""
    whole_map: bool = True
    """Search for a photo that no candidate's map matches by the features of the whole map too, up
    to some 12 square kilometres: made once, half a minute a square kilometre, and kept beside the
    index. Not within --near."""
    dense: bool = True
    """Match a photo that SIFT does not place by the built-in encoder's dense features too, where
    tags tell its pose: some 0.5 s a window."""

    def __post_init__(self) -> None:
        FlightSettings.__post_init__(self)
        PoseSettings.__post_init__(self)
        require(self.top >= 1, "top", self.top, "at least 1")
        if self.together and self.track:
            raise InputError(
                "both --together and --track were given, expected one: a track is of single "
                "photos; leave one out"
            )


@dataclass(frozen=True, kw_only=True)
class CalibrateSettings(CalibrationCriteria):
    """The index to calibrate, and the photos to do it with."""

    checkpoint: str = BUILTIN
    "The encoder that the index was made with."
    shards: str
    """Folder or URI of shards with photos of locations that the encoder was not trained on, and the
    gallery's view of them; with --flight, the shards that the index was made of."""
    flight: str | None = None
    """Table of photos over the map with the places that they show, such as photos.csv of
    jobs/fly.py (columns path, lat, lon): they are searched and matched, with and without the
    camera's tags, instead of the shards' photos."""
    surface: Annotated[str | None, SURFACE_FLAG] = None
    "With --flight, a surface model of the map's ground, if photos are to be located with one."
    index: str
    "Folder or URI of the index."
    out: str | None = None
    "The calibration; by default INDEX/calibration.json."
    split: Split = Split.TRAIN
    """Split of the photos; in the training split, only locations held out (train.py --hold-out).
    Never the test set's."""
    view: View = View.DRONE
    "View of the photos."
    gallery_view: View = View.SATELLITE
    "View of the gallery's images."
    photos: int = 2000
    "Number of photos at most."

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.photos >= 1, "photos", self.photos, "at least 1")


@dataclass(frozen=True, kw_only=True)
class ServeSettings(ServiceSettings):
    """The index, its encoder, the address and the limits of the service."""

    checkpoint: str = BUILTIN
    "The checkpoint that the index's gallery was embedded with."
    index: str
    "Folder or URI of the index; the service switches to one that is built there later."
    shards: str | None = None
    """The shards that the index was made of: photos are matched with their pixels, and the page
    shows them."""
    match: bool = True
    """Match each photo with the map's pixels around its candidates, as jobs/locate.py does. Takes
    --shards whose tiles know their corners; --no-match answers with tiles."""
    dense: bool = True
    """Match a photo that SIFT does not place by the built-in encoder's dense features too, where
    tags tell its pose: some 0.5 s a window."""
    surface: Annotated[str | None, SURFACE_FLAG] = None
    """A surface model of the map's ground (a GeoTIFF of heights): roofs and slopes are then placed
    where they stand. By default the one that jobs/adapt.py was given."""
    replicas: int = 1
    "Processes that each load encoder and index."
    threads: int | None = None
    "CPU cores of each; by default as many as let all of them fit on the nodes that are up."

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.replicas >= 1, "replicas", self.replicas, "at least 1")
        require(self.threads is None or self.threads >= 1, "threads", self.threads, "at least 1")


SIDES = {"sample4geo": 384, "qdfl": 280}
"Image size of a test by the authors' code in pixels; 256 for all others."


@dataclass(frozen=True, kw_only=True)
class ImportWeightsSettings:
    """Which public weights are imported, and where to."""

    out: str
    "File or URI of the checkpoint."
    torchvision: str | None = None
    "State dict of torchvision's ResNet-18, 34, 50 or 101 (.pth or .safetensors)."
    lpn: str | None = None
    "State dict of LPN's three_view_net (its net_119.pth), trained with --share and --stride=1."
    fsra: str | None = None
    "State dict of FSRA's two_view_net (its net_119.pth)."
    sample4geo: str | None = None
    "State dict of Sample4Geo's TimmModel, a ConvNeXt of timm (its weights_*.pth)."
    mccg: str | None = None
    "State dict of MCCG's two_view_net, a ConvNeXt-T (its net_*.pth)."
    qdfl: str | None = None
    "Checkpoint of QDFL's U1652_model, DINOv2 with adapters (of Lightning, .ckpt)."
    image_size: int | None = None
    """Side of the network's input images in pixels: `h` in LPN's opts.yaml. By default 256, for
    Sample4Geo 384, for QDFL the 280 of its test."""

    def __post_init__(self) -> None:
        if len(self._given) != 1:
            flags = ", ".join(f"--{kind}" for kind in self.KINDS)
            found = " and ".join(f"--{kind}" for kind in self._given) or "none"
            raise InputError(f"{found} given, expected one of {flags}")

    KINDS: ClassVar[tuple[str, ...]] = (
        "torchvision", "lpn", "fsra", "sample4geo", "mccg", "qdfl",
    )  # fmt: skip
    "What can be imported: flags."

    @property
    def _given(self) -> dict[str, str]:
        flags = {kind: getattr(self, kind) for kind in self.KINDS}
        return {kind: path for kind, path in flags.items() if path is not None}

    @property
    def kind(self) -> str:
        return next(iter(self._given))

    @property
    def source(self) -> str:
        return self._given[self.kind]

    @property
    def side(self) -> int:
        return self.image_size or SIDES.get(self.kind, 256)


@dataclass(frozen=True, kw_only=True)
class DemoSettings:
    """The demo's folder and sizes."""

    out: str = "runs/demo"
    "Folder for all of its outputs."
    train_locations: int = 230
    "Locations for training, including those held out."
    hold_out: float = 0.13
    "Share of these held out of training: the answers' probabilities are calibrated by them."
    test_locations: int = 100
    "Locations to find; none of them is seen in training."
    distractors: int = 50
    "Locations in the gallery only."
    views: int = 12
    "UAV images per location."
    size: int = 128
    "Side of the images in pixels."
    epochs: int = 4
    "Epochs of recipe finetune."


@dataclass(frozen=True, kw_only=True)
class ExportWeightsSettings:
    """Which encoder is exported, and where to."""

    checkpoint: str
    "A last.pt of jobs/train.py, or what jobs/import_weights.py wrote."
    out: str
    "File or URI, ending in .safetensors."

    def __post_init__(self) -> None:
        ending = "a name that ends in .safetensors"
        require(self.out.endswith(".safetensors"), "out", self.out, ending)
