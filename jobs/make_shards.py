"""Pack imagery into webdataset shards: `make_shards.py --source university1652 --root DIR --out DIR`

A finished set is checked by `make_shards.py --verify --out DIR`, and `make_shards.py --export FILE
--out DIR` writes its record table as Parquet or GeoJSON.
"""

from typing import TYPE_CHECKING

import tyro

from jobs.command_line.cli import run
from jobs.command_line.config import Choice
from jobs.stages.settings import MakeShardsSettings
from pipeline.core.errors import InputError
from pipeline.sources import SOURCES, name_of
from pipeline.sources.base import Source

SOURCE = Choice(name="source", names=tuple(SOURCES), name_of=name_of, flag=True)

if TYPE_CHECKING:
    SourceChoice = Source
else:  # subcommands of the command line: each source has flags of its own
    SourceChoice = tyro.extras.subcommand_type_from_defaults(
        {name: kind() for name, kind in SOURCES.items()},
        {name: (kind.__doc__ or "").splitlines()[0] for name, kind in SOURCES.items()},
        prefix_names=False,
    )


def main(settings: MakeShardsSettings, source: SourceChoice | None = None) -> None:
    """Pack imagery into webdataset shards, or check or export a finished set.

    `--source NAME` names the imagery's layout; `--source NAME --help` lists the layout's flags.
    """
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
