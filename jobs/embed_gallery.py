"""Embed shards into a feature table: `embed_gallery.py --shards DIR --checkpoint FILE --out
TABLE`
"""

from dataclasses import fields
from functools import cache

from jobs.command_line.cli import run
from jobs.encoding.settings import EncoderSettings
from jobs.stages.settings import EmbedSettings
from pipeline.core import storage
from pipeline.features.settings import EmbeddingSettings


def main(settings: EmbedSettings) -> None:
    """Embed shards into a feature table, one part per shard; finished parts are skipped."""
    from jobs.encoding.encoder import make_encoder_spec, read_checkpoint_bytes
    from pipeline.features.embed import embed_gallery
    from pipeline.shards.shard_set import ShardSet, open_or_scan

    checkpoint = read_checkpoint_bytes(settings.checkpoint)
    given = {field.name: getattr(settings, field.name) for field in fields(EmbeddingSettings)}
    given |= {"shards": storage.absolute(settings.shards), "out": storage.absolute(settings.out)}
    embedding = EmbeddingSettings(**given)
    encoder = EncoderSettings(
        **{field.name: getattr(settings, field.name) for field in fields(EncoderSettings)}
    )

    @cache  # of shards without a manifest it takes a pass over all tars
    def open_set() -> ShardSet:
        return open_or_scan(embedding.shards, embedding.split, embedding.view)

    spec = make_encoder_spec(checkpoint, settings.checkpoint, embedding, encoder, open_set)
    embed_gallery(embedding, spec, open_set())


if __name__ == "__main__":
    run(main)
