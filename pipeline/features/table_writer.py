"""The books of a feature table that is being filled: expected parts, done parts, skipped ones.

In: the parts that a run is to make. Out: those that are still to be made, and at the end the list
of expected parts and the list of rejected images as they are. Workers write the parts themselves
(`part.write_part`), each atomically; so a killed run leaves complete parts and resumes with the
others.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.progress import console
from pipeline.core.records import Rejection
from pipeline.features.encoding import EncodingConfig
from pipeline.features.expected_parts import (
    add_expected,
    expected_parts_file,
    remove_expected,
)
from pipeline.features.part import PartHeader, part_names, read_header, read_headers, verify_part
from pipeline.features.rejected import rejected_file, write_rejected


@dataclass(frozen=True, kw_only=True)
class ExpectedPart:
    """A part that a table is to have."""

    name: str
    "File name within the table."
    shard_sha256: str
    "Hash of the shard that it is made of."
    images: int
    "Of the shard; as many as the part has rows and rejected images."


@dataclass(frozen=True, kw_only=True)
class WrittenTable:
    """What a finished run leaves."""

    rejected: tuple[Rejection, ...]
    "Images without a row, of all parts."
    list_changed: bool
    "Whether the list of them is another than before the run."


def encoding_of_parts(path: str) -> EncodingConfig | None:
    """How the parts that a table has already were encoded; None without an intact one."""
    for name in part_names(path):
        with suppress(InputError):
            return read_header(storage.join(path, name)).footer.encoding
    return None


class FeatureTableWriter:
    """Keeps the books of one table: `expect` parts, `skip` those that cannot be made, `finish`."""

    def __init__(self, path: str, fingerprint: str, dtype: str) -> None:
        """`fingerprint`: of the encoder; `dtype`: of the embeddings to be stored."""
        self.path = path
        self._fingerprint, self._dtype = fingerprint, dtype
        self._expected: dict[str, ExpectedPart] = {}
        self._skipped: dict[str, tuple[str, str]] = {}

    def expect(self, parts: Sequence[ExpectedPart], verify: bool = False) -> list[str]:
        """Record that the table is to have these parts; returns the names of those to be made.

        A part is done when it is complete and was made of this very shard; with `verify` every byte
        of it is compared with its checksum. Damaged parts are made again. Raises InputError when
        the table holds another encoder's parts, or another dtype.
        """
        self._expected = {part.name: part for part in parts}
        done = {name for name in part_names(self.path) if self._is_done(name, verify)}
        add_expected(self.path, self._expected)
        return [name for name in self._expected if name not in done]

    def _is_done(self, name: str, verify: bool) -> bool:
        path, expected = storage.join(self.path, name), self._expected.get(name)
        try:
            header = read_header(path)
            if verify:
                verify_part(path)
        except InputError as error:
            if expected is None:
                raise
            console.print(f"{error}; it is embedded again", style="yellow")
            return False
        self._check_same_encoder(header)
        if expected is None:
            return False
        images = header.footer.rows + len(header.footer.rejected)
        return (header.footer.shard_sha256, images) == (expected.shard_sha256, expected.images)

    def _check_same_encoder(self, header: PartHeader) -> None:
        """Raise InputError where a part of the table cannot stand beside those to be made."""
        path, made_by = storage.join(self.path, header.name), header.footer.fingerprint
        if made_by != self._fingerprint:
            raise InputError(
                f"{path} was made by network {made_by[:12]}, this checkpoint is "
                f"{self._fingerprint[:12]}; choose another --out, the --precision, --resizer and "
                "--mirror that it was made with, or delete the old table"
            )
        if header.dtype != self._dtype:
            raise InputError(
                f"{path} holds {header.dtype}, --dtype is {self._dtype}, expected one kind of "
                f"numbers in a table; choose another --out, or --dtype {header.dtype}"
            )

    def skip(self, name: str, reason: str, found: str) -> None:
        """Record that a part cannot be made, and why."""
        self._skipped[name] = reason, found

    def finish(self) -> WrittenTable:
        """Bring the lists up to date and remove what killed writers left half-written."""
        remove_expected(self.path, self._skipped)
        storage.remove_temporaries(self.path, self._expected)
        for path in (expected_parts_file(self.path), rejected_file(self.path)):
            folder, _, name = path.rpartition("/")
            storage.remove_temporaries(folder, [name])
        rejected = [
            (_stem(header.name), one)
            for header in read_headers(self.path)
            for one in header.footer.rejected
        ]
        listed = [(shard, one.path, one.reason, one.found) for shard, one in rejected]
        skipped = [(_stem(name), None, *why) for name, why in self._skipped.items()]
        return WrittenTable(
            rejected=tuple(one for _, one in rejected),
            list_changed=write_rejected(self.path, [*listed, *skipped]),
        )


def _stem(part: str) -> str:
    """The name of the shard that a part is made of."""
    return part.removesuffix(".parquet")
