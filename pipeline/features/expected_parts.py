"""Which parts a feature table has: said before the first one is made, so that whoever opens the
table misses none.

In: names of parts. Out: `_parts.json` in the table's folder, whose underscore keeps it from readers
that look into folders. A table without it, of others or from before there were such lists, is what
is there.
"""

from collections.abc import Iterable

from pipeline.core import json_files, storage
from pipeline.core.errors import InputError

EXPECTED_PARTS = "_parts.json"


def add_expected(table: str, names: Iterable[str]) -> None:
    """These parts, besides those that were promised before, are the table's."""
    known = set(_read(table, mending=True))
    if not known.issuperset(promised := set(names)):
        _write(table, known | promised)


def remove_expected(table: str, names: Iterable[str]) -> None:
    """These parts are not to come: their shards could not be embedded, and that was said."""
    if lost := set(names):
        _write(table, set(_read(table)) - lost)


def check_expected(table: str, there: Iterable[str]) -> None:
    """Raise InputError where a promised part is not there."""
    promised = set(_read(table))
    missing = sorted(promised.difference(there))
    if missing:
        raise InputError(
            f"{table} lacks {len(missing)} of the {len(promised)} parts that it is to have, {missing[0]} first; run the "
            f"embed_gallery command that fills it again, or delete {storage.join(table, EXPECTED_PARTS)} where it is meant to do without"
        )


def _read(table: str, mending: bool = False) -> list[str]:
    path = storage.join(table, EXPECTED_PARTS)
    if not storage.exists(path):
        return []
    try:
        return [str(name) for name in json_files.read_checksummed(path)["parts"]]
    except (KeyError, TypeError, ValueError) as error:
        if mending:
            return []
        raise InputError(
            f"{path} is damaged ({error}), expected the list of the table's parts; run the embed_gallery command that "
            "fills the table again, which writes it"
        ) from None


def _write(table: str, names: set[str]) -> None:
    json_files.write_checksummed(storage.join(table, EXPECTED_PARTS), {"parts": sorted(names)})
