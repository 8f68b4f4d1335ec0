"""Shards + checkpoint -> feature table: `embed_gallery.py --shards DIR --checkpoint FILE --out TABLE`."""

from dataclasses import dataclass, fields

from jobs.cli import run
from jobs.encoders import EncoderSettings, network_of
from pipeline import storage
from pipeline.embed import EmbeddingSettings, embed_gallery
from pipeline.records import InputError


@dataclass(frozen=True, kw_only=True)
class Settings(EmbeddingSettings, EncoderSettings):
    """Which shards are embedded, by which network, into which table."""

    checkpoint: str
    "A last.pt of jobs/train.py, or what jobs/import_weights.py wrote."


def main(settings: Settings) -> None:
    """Embed shards into a feature table, one part per shard; finished parts are skipped."""
    if not storage.exists(settings.checkpoint):
        raise InputError(
            f"no checkpoint at {settings.checkpoint}; expected a last.pt of jobs/train.py; check --checkpoint"
        )
    given = {field.name: getattr(settings, field.name) for field in fields(EmbeddingSettings)}
    given |= {"shards": storage.absolute(settings.shards), "out": storage.absolute(settings.out)}
    embedding = EmbeddingSettings(**given)
    encoder = EncoderSettings(**{field.name: getattr(settings, field.name) for field in fields(EncoderSettings)})
    network = network_of(storage.read_bytes(settings.checkpoint), settings.checkpoint, embedding, encoder)
    embed_gallery(embedding, network)


if __name__ == "__main__":
    run(main)
