"""Imagery -> shards: `make_shards.py --source university1652 --root DIR --out DIR`.

And of a finished set: `make_shards.py --verify --out DIR` checks every byte, `make_shards.py
--export FILE --out DIR` writes its record table as Parquet or GeoJSON.
"""

import sys
from typing import TYPE_CHECKING

import tyro

from jobs.command_line.cli import run
from pipeline.core import storage
from pipeline.core.errors import Incomplete, InputError
from pipeline.core.progress import console
from pipeline.shards import record_table
from pipeline.shards.manifest import read_manifest
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.shards.verify import verify as verify_shards
from pipeline.sources import SOURCES
from pipeline.sources.base import Source

if TYPE_CHECKING:
    SourceChoice = Source
else:  # subcommands of the command line: each source has flags of its own
    SourceChoice = tyro.extras.subcommand_type_from_defaults(
        {name: kind() for name, kind in SOURCES.items()},
        {name: (kind.__doc__ or "").splitlines()[0] for name, kind in SOURCES.items()},
        prefix_names=False,
    )


def source_as_subcommand(arguments: list[str]) -> list[str]:
    """`--source NAME`, which the parser knows as the subcommand NAME.

    Raises InputError where no such source is, or none is named.
    """
    for place, word in enumerate(arguments):
        name, equals, value = word.partition("=")
        if name != "--source":
            continue
        chosen = value if equals else "".join(arguments[place + 1 : place + 2])
        if chosen not in SOURCES:
            raise InputError(f"--source is {chosen!r}, expected one of: {', '.join(SOURCES)}")
        return [chosen, *arguments[:place], *arguments[place + (1 if equals else 2) :]]
    if arguments and not {*SOURCES, "--help", "-h"} & set(arguments):
        raise InputError(
            f"--source is missing, expected one of: {', '.join(SOURCES)}; see make_shards.py --help"
        )
    return arguments


def main(source: SourceChoice, packing: PackingSettings) -> None:
    """Pack imagery into webdataset shards.

    Begin with `--source NAME`; `--source NAME --help` lists its flags. `--verify --out DIR` checks a finished set,
    `--export FILE --out DIR` writes its record table as .parquet or .geojson.
    """
    pack(source, packing)


def check(out: str, verify: bool = False) -> None:
    """Check every tar, count and hash of a finished set of shards.

    Args:
        out: Folder or URI of the shards.
        verify: Said to ask for this.
    """
    count, wrong = verify_shards(out)
    for sentence in wrong:
        console.print(sentence)
    if wrong:
        raise Incomplete(
            f"{out} is damaged in {len(wrong)} places; run the command that packed it again: it makes anew the shards that are "
            "named, and no others"
        )
    console.print(f"{out}: all {count} shards are what was packed")


def export(out: str, export: str) -> None:
    """Write the record table of a finished set of shards.

    Args:
        out: Folder or URI of the shards.
        export: The file: .parquet, or .geojson with a point for each image whose place is known.
    """
    written, without = record_table.export(storage.absolute(out), read_manifest(out), export)
    console.print(
        f"{export}: {written} images" + (f", {without} without a place left out" if without else "")
    )


if __name__ == "__main__":
    if "--verify" in sys.argv:
        run(check)
    elif any(word.partition("=")[0] == "--export" for word in sys.argv):
        run(export)
    else:
        run(main, source_as_subcommand)
