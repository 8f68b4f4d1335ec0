"""Packing, checking and exporting a set of shards, with their results on the terminal."""

from dataclasses import fields

from jobs.stages.settings import MakeShardsSettings
from pipeline.core.errors import Incomplete, require
from pipeline.core.progress import console
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.shards.shard_set import open_shards
from pipeline.shards.verify import verify
from pipeline.sources.base import Source


def pack_source(source: Source, settings: MakeShardsSettings) -> None:
    """Pack a source's imagery. Raises InputError without `root`."""
    require(bool(settings.root), "root", settings.root, "the folder of the imagery")
    given = {field.name: getattr(settings, field.name) for field in fields(PackingSettings)}
    pack(source, PackingSettings(**given))


def verify_shards(out: str) -> None:
    """Check every tar, count and hash of a finished set. Raises Incomplete where it is damaged."""
    shards = open_shards(out)
    wrong = verify(shards)
    for sentence in wrong:
        console.print(sentence)
    if wrong:
        raise Incomplete(
            f"{out} is damaged in {len(wrong)} places; run the command that packed it again: it "
            "repairs the shards that are named, and no others"
        )
    console.print(f"{out}: all {len(shards.manifest.shards)} shards are what was packed")


def export_records(out: str, path: str) -> None:
    """Write the record table of a finished set: .parquet, or .geojson with a point for each image
    whose position is known.
    """
    written, without = open_shards(out).export(path)
    console.print(
        f"{path}: {written} images"
        + (f", {without} without a position left out" if without else "")
    )
