"""Imagery -> shards: `make_shards.py --source university1652 --root DIR --out DIR`."""

from typing import TYPE_CHECKING

import tyro

from jobs.cli import Failure, run
from pipeline.records import InputError
from pipeline.shards import PackingSettings, TooManyRejected, pack
from pipeline.sources import SOURCES
from pipeline.sources.source import Source

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

    Raises InputError where no such source is.
    """
    rest = list(arguments)
    for place, word in enumerate(arguments):
        name, equals, value = word.partition("=")
        if name != "--source":
            continue
        chosen = value if equals else "".join(arguments[place + 1 : place + 2])
        if chosen not in SOURCES:
            raise InputError(f"--source is {chosen!r}, expected one of: {', '.join(SOURCES)}")
        del rest[place : place + (1 if equals else 2)]
        return [chosen, *rest]
    return rest


def main(source: SourceChoice, packing: PackingSettings) -> None:
    """Pack imagery into webdataset shards. Begin with `--source NAME`; `--source NAME --help` lists its flags."""
    try:
        pack(source, packing)
    except TooManyRejected as error:
        raise Failure(str(error)) from None


if __name__ == "__main__":
    run(main, source_as_subcommand)
