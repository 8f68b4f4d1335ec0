"""A tar of webdataset's layout -> its samples as named bytes, in one pass, by webdataset's own
iterators.

In: a tar as a stream. Out: per sample its key and its members by suffix. Broken and hostile tars
are refused by the guard in front of webdataset. Nothing is unpacked to disk, nothing unpickled.
Never used: `WebDataset(...)`, whose reader silently drops the rest of a damaged tar; `gopen`, which
runs a shell for `pipe:` URLs; `decode`, which unpickles.
"""

import re
import tarfile
from collections import Counter
from collections.abc import Iterator
from typing import IO, NoReturn

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.shards.tar_guard import GZIP_ERRORS, GuardedTar, gunzipped

IMAGE_SUFFIXES = ("jpg", "jpeg", "png", "webp", "tif", "tiff", "bmp", "gif", "ppm")
"Suffixes of the members that are images."
METADATA_SUFFIXES = ("json", "cls")
"""Suffixes of the members that describe an image. All others are skipped: captions, masks,
pickles."""
ALL_SUFFIXES = IMAGE_SUFFIXES + METADATA_SUFFIXES
OUTSIDE = re.compile(r"[/\\]|.:|(?:.*[/\\])?\.\.(?:[/\\]|$)", re.DOTALL)
"Names that lead out of the folder that a tar is unpacked in."
DUPLICATE = re.compile(r"(.*): duplicate file name in tar file", re.DOTALL)
"webdataset's message about two members of a sample with the same ending."


def read_tar(
    path: str, suffixes: tuple[str, ...] = ALL_SUFFIXES, external: bool = False
) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Key and members (suffix -> bytes) of each sample of a tar, in its order; members with other
    suffixes are skipped.

    A sample is a run of members whose names agree up to the first dot after the folder, as in
    webdataset. Raises InputError where the tar ends too early, is no tar, or has a member name that
    leads out of it.
    """
    with storage.open_read(path) as stream:
        yield from read_members(stream, path, suffixes, external)


def read_members(
    stream: IO[bytes],
    path: str,
    suffixes: tuple[str, ...],
    external: bool = False,
    skipped: Counter[str] | None = None,
) -> Iterator[tuple[str, dict[str, bytes]]]:
    """`read_tar` of an open stream, from its start to its end; `path` is named in the errors.

    `external`: a tar that others made, which may be compressed by gzip, and whose names may hold
    more than one dot (`split_external_name`). `skipped` counts the endings of skipped members.
    """
    # Imported here because it imports torch, which packing does without.
    from webdataset.tariterators import base_plus_ext, group_by_keys, tar_file_expander

    def is_wanted(name: str) -> bool:
        check_member_name(name, path)
        file = name.rpartition("/")[2]
        if file.startswith("."):  # such as the `._a.jpg` that macOS writes beside `a.jpg`
            if skipped is not None:
                skipped["hidden"] += 1
            return False
        suffix = file.partition(".")[2].lower()
        ending = suffix.rpartition(".")[2] if external else suffix
        if ending not in suffixes and skipped is not None:
            skipped[f".{ending}" if ending else "no ending"] += 1
        return ending in suffixes

    guard, samples = GuardedTar(gunzipped(stream) if external else stream, external), 0
    try:
        members = tar_file_expander(
            [{"url": path, "stream": guard}],
            handler=_reraise,
            select_files=is_wanted,
            rename_files=_without_dot_folder,
        )
        split = split_external_name if external else base_plus_ext
        for sample in group_by_keys(members, keys=split, handler=_reraise):
            key = sample.pop("__key__")
            del sample["__url__"]
            yield key, sample
            samples += 1
        guard.finish()
    except InputError as error:
        raise InputError(_reason(error, guard)) from None
    # ValueError and RecursionError are raised for headers that make no sense.
    except (*GZIP_ERRORS, tarfile.TarError, EOFError, ValueError, RecursionError) as error:
        if twice := DUPLICATE.match(_reason(error, guard)):
            raise InputError(
                f"{path} holds a second {twice[1]} in one sample (capital and small letters are "
                "the same in endings), expected one file of each ending; pack the tar again "
                "without one of them"
            ) from None
        raise InputError(
            f"{path} is cut off or damaged after {samples} samples ({_reason(error, guard)}), "
            "expected a complete tar; copy it again from where it came from, or pack again with "
            "jobs/make_shards.py"
        ) from None


def split_external_name(name: str) -> tuple[str | None, str | None]:
    """Key and suffix of a member's name. Parts between dots that begin with a digit belong to the
    key, as in `ortho_v1.2.jpg`; others to the suffix, as in `000.rgb.jpg`.

    webdataset's own split, at the first dot, would make one sample of `v1.2.jpg` and `v1.3.jpg`.
    """
    folder, slash, file = name.rpartition("/")
    first, *parts = file.split(".")
    if not first or not parts:
        return None, None
    while len(parts) > 1 and parts[0][:1].isdigit():
        first = f"{first}.{parts.pop(0)}"
    return folder + slash + first, ".".join(parts)


def check_member_name(name: str, path: str) -> None:
    """Raise InputError where a member's name leads out of the tar's own folder."""
    if OUTSIDE.match(name):
        raise InputError(
            f"{path} holds a member named {name!r}, expected a name below the tar's own folder; do "
            "not unpack this tar, and have it packed again with plain names"
        )


def _without_dot_folder(name: str) -> str:
    return name.removeprefix("./")


def _reraise(error: Exception) -> NoReturn:
    raise error


def _reason(error: Exception, guard: GuardedTar) -> str:
    """An error's message without the stream that webdataset appends to it."""
    return str(error.args[0]).removesuffix(f" @ {guard}") if error.args else type(error).__name__
