"""The list of parts that a feature table is to have, recorded before the first one is written.

In: names of parts. Out: `_parts.json` in the table's folder, by which opening a table notices a
missing part; readers that take folders skip its underscore. A table without the list, such as an
imported one, has the parts that are there.
"""

from collections.abc import Iterable

from pipeline.core import json_files, storage
from pipeline.core.errors import InputError

EXPECTED_PARTS = "_parts.json"


def add_expected(table: str, names: Iterable[str]) -> None:
    """Add parts to the list; those that were added before stay. A damaged list is replaced."""
    known = set(_read(table, replace_damaged=True))
    if not known.issuperset(added := set(names)):
        _write(table, known | added)


def remove_expected(table: str, names: Iterable[str]) -> None:
    """Take parts off the list: their shards could not be embedded, and that was reported."""
    if removed := set(names):
        _write(table, set(_read(table)) - removed)


def check_expected(table: str, present: Iterable[str]) -> None:
    """Raise InputError where an expected part is not present."""
    expected = set(_read(table))
    missing = sorted(expected.difference(present))
    if missing:
        raise InputError(
            f"{table} lacks {len(missing)} of the {len(expected)} parts that it is to have, "
            f"{missing[0]} first; run the embed_gallery command that fills it again, or delete "
            f"{storage.join(table, EXPECTED_PARTS)} where it is meant to do without"
        )


def _read(table: str, replace_damaged: bool = False) -> list[str]:
    path = storage.join(table, EXPECTED_PARTS)
    if not storage.exists(path):
        return []
    try:
        return [str(name) for name in json_files.read_checksummed(path)["parts"]]
    except (KeyError, TypeError, ValueError) as error:
        if replace_damaged:
            return []
        raise InputError(
            f"{path} is damaged ({error}), expected the list of the table's parts; run the "
            "embed_gallery command that fills the table again, which writes it"
        ) from None


def _write(table: str, names: set[str]) -> None:
    json_files.write_checksummed(storage.join(table, EXPECTED_PARTS), {"parts": sorted(names)})
