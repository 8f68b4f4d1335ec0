"""The list of parts that a feature table is to have, recorded before the first one is written.

In: names of parts. Out: `TABLE.parts.json`, by which opening a table notices a missing part. It
stands beside the table's folder, since some readers (Polars) take every file within it for a part.
A table without the list, such as an imported one or one that was copied alone, has the parts that
are there.
"""

from collections.abc import Iterable

from pipeline.core import json_files, storage
from pipeline.core.errors import InputError

PARTS_ENDING = ".parts.json"
"Behind the table's path."
OLD_PARTS_NAME = "_parts.json"
"Within the table, where tables had the list at first; adding parts moves it."


def expected_parts_file(table: str) -> str:
    """The path of a table's list, of the old one where there is only that."""
    path, old = storage.beside(table, PARTS_ENDING), storage.join(table, OLD_PARTS_NAME)
    return old if not storage.exists(path) and storage.exists(old) else path


def add_expected(table: str, names: Iterable[str]) -> None:
    """Add parts to the list; those that were added before stay, unless the table's folder is gone.
    A damaged list is replaced.
    """
    old = storage.join(table, OLD_PARTS_NAME)
    known = set(_read(table, replace_damaged=True)) if storage.is_folder(table) else set[str]()
    if not known.issuperset(added := set(names)) or storage.exists(old):
        _write(table, known | added)
    if storage.exists(old):
        storage.remove(old)
    storage.make_folder(table)  # from now on the list is this table's


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
            f"{expected_parts_file(table)} where it is meant to do without"
        )


def _read(table: str, replace_damaged: bool = False) -> list[str]:
    path = expected_parts_file(table)
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
    json_files.write_checksummed(storage.beside(table, PARTS_ENDING), {"parts": sorted(names)})
