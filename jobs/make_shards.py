"""Pack imagery into webdataset shards: `make_shards.py --source university1652 --root DIR --out
DIR`

A finished set is checked by `make_shards.py --verify --out DIR`, and `make_shards.py --export FILE
--out DIR` writes its record table as Parquet or GeoJSON.
"""

from jobs.command_line.cli import run
from jobs.command_line.config import Choice
from jobs.stages.settings import MakeShardsSettings
from pipeline.core.errors import InputError
from pipeline.sources import SOURCES, name_of, source_class
from pipeline.sources.base import Source

SOURCE = Choice(
    name="source",
    names=tuple(SOURCES),
    name_of=name_of,
    kind_of=source_class,
    help=f"Layout of the imagery: {', '.join(SOURCES)}; --source NAME --help lists its flags.",
)


def main(settings: MakeShardsSettings, source: Source | None = None) -> None:
    """Pack imagery into webdataset shards, or check or export a finished set."""
    from jobs.stages.shards import export_records, pack_source, verify_shards

    if settings.verify:
        verify_shards(settings.out)
    elif settings.export is not None:
        export_records(settings.out, settings.export)
    elif source is None:
        known = ", ".join(SOURCES)
        raise InputError(
            f"--source is missing, expected one of: {known}; see make_shards.py --help"
        )
    else:
        pack_source(source, settings)


if __name__ == "__main__":
    run(main, SOURCE)
