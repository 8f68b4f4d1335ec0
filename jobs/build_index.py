"""Feature table -> FAISS index: `build_index.py --table TABLE --out INDEX`.

And of a finished index: `--extend --table TABLE --out INDEX` adds the table's new parts, `--remove
LOCATION ... --out INDEX` makes locations answer no more, `--verify --out INDEX` looks at every
byte. `--verify` while building: of the table.
"""

import sys

import tyro

from jobs.command_line.cli import run
from pipeline.index.build import build_index
from pipeline.index.settings import IndexSettings
from pipeline.index.update import extend_index, remove_locations, verify_index


def main(settings: IndexSettings) -> None:
    """Build a searchable index of a feature table, within a memory budget.

    Of a finished index: `--extend --table TABLE --out INDEX` adds the table's new parts, `--remove
    LOCATION ... --out INDEX` makes locations answer no more, `--verify --out INDEX` looks at every
    byte.
    """
    build_index(settings)


def extend(
    table: str, out: str, extend: tyro.conf.FlagCreatePairsOff[bool] = False, workers: int = 0
) -> None:
    """Add those parts of a table to a finished index that it does not hold yet."""
    extend_index(table, out, workers)


def remove(out: str, remove: tuple[str, ...]) -> None:
    """Make locations of a finished index answer no more."""
    remove_locations(out, remove)


def verify(out: str, verify: tyro.conf.FlagCreatePairsOff[bool] = False) -> None:
    """Look at every byte of a finished index."""
    verify_index(out)


if __name__ == "__main__":
    words = {word.partition("=")[0] for word in sys.argv}
    run(
        extend if "--extend" in words else remove if "--remove" in words
        else verify if "--verify" in words and "--table" not in words else main
    )  # fmt: skip
