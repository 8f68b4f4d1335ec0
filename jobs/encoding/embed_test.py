"""The test images of a set of shards, queries and gallery, into one feature table.

In: shards and a checkpoint. Out: the table; parts that are finished are kept.
"""

from jobs.encoding.encoder import make_encoder_spec, read_checkpoint_bytes
from pipeline.core.records import Split
from pipeline.features.embed import embed_gallery
from pipeline.features.settings import EmbeddingSettings


def embed_test(shards: str, checkpoint: str, table: str) -> None:
    """Embed both splits of the test, in this process: small sets, for which Ray's workers take
    longer to start. Raises InputError or CheckpointError as `embed_gallery`."""
    data = read_checkpoint_bytes(checkpoint)
    for split in (Split.QUERY, Split.GALLERY):
        embedding = EmbeddingSettings(shards=shards, out=table, split=split, workers=0)
        embed_gallery(embedding, make_encoder_spec(data, checkpoint, embedding))
