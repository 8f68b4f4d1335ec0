"""Shards + checkpoint -> feature table: `embed_gallery.py --shards DIR --checkpoint FILE --out
TABLE`.
"""

from dataclasses import dataclass, fields

from jobs.command_line.cli import run
from jobs.encoding.encoder import make_encoder_spec, read_checkpoint_bytes
from jobs.encoding.settings import EncoderSettings
from pipeline.core import storage
from pipeline.features.embed import embed_gallery
from pipeline.features.settings import EmbeddingSettings


@dataclass(frozen=True, kw_only=True)
class Settings(EmbeddingSettings, EncoderSettings):
    """Which shards are embedded, by which network, into which table."""

    checkpoint: str
    "A last.pt of jobs/train.py, or what jobs/import_weights.py wrote."


def main(settings: Settings) -> None:
    """Embed shards into a feature table, one part per shard; finished parts are skipped."""
    checkpoint = read_checkpoint_bytes(settings.checkpoint)
    given = {field.name: getattr(settings, field.name) for field in fields(EmbeddingSettings)}
    given |= {"shards": storage.absolute(settings.shards), "out": storage.absolute(settings.out)}
    embedding = EmbeddingSettings(**given)
    encoder = EncoderSettings(
        **{field.name: getattr(settings, field.name) for field in fields(EncoderSettings)}
    )
    network = make_encoder_spec(checkpoint, settings.checkpoint, embedding, encoder)
    embed_gallery(embedding, network)


if __name__ == "__main__":
    run(main)
