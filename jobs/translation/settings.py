"""The settings of a translation: flags of jobs/translate.py. Imports nothing heavy."""

from dataclasses import dataclass

from pipeline.core.errors import require


@dataclass(frozen=True, kw_only=True)
class TranslateSettings:
    """Which shards are translated, by a GAN of what size, trained for how long."""

    shards: str
    "Folder or URI of the shards; the GAN learns from their training split."
    out: str
    "Folder for generator.pt, images/ and shards/."
    epochs: int = 200
    "Of the GAN; an epoch has each place once [pix2pix: 200]."
    batch_size: int = 4
    "Pairs in a step [pix2pix: 1 to 16]."
    side: int = 256
    "Of the translated images in pixels: a power of 2, at least 32."
    channels: int = 64
    "Of the networks' outermost layers [pix2pix: 64]."
    l1_weight: float = 100.0
    "Of the distance to the real satellite image [pix2pix: 100]."
    seed: int = 0
    "Of weights, order and dropout."

    def __post_init__(self) -> None:
        for name in ("epochs", "channels"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        require(self.batch_size >= 2, "batch_size", self.batch_size, "at least 2, for BatchNorm")
        power = self.side >= 32 and not self.side & (self.side - 1)
        require(power, "side", self.side, "a power of 2, 32 or more")
        require(self.l1_weight >= 0, "l1_weight", self.l1_weight, "0 or more")
