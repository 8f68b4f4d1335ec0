"""JSON files that carry a SHA-256 checksum of their own content, and JSON validated into
dataclasses.

In: an object and a path. Out: a JSON file that any program reads, and the object again, or a
ValueError if the content is not what was written. `from_json` parses a decoded object into a
dataclass and checks the type of every field, because a file may come from anyone.
"""

import hashlib
import json
from collections.abc import Sequence
from functools import cache
from typing import Any, TypeVar, cast

from pydantic import ConfigDict, TypeAdapter, ValidationError

from pipeline.core import storage
from pipeline.core.records import excerpt, is_utf8

T = TypeVar("T")

CHECKSUM_KEY = "checksum"
"Name of the last entry of a file."
CHECKSUM_PREFIX = "sha256:"


def write_checksummed(path: str, content: dict[str, Any]) -> None:
    """Write an object as a JSON file with its checksum, atomically."""
    storage.write_json(path, content | {CHECKSUM_KEY: checksum_of(content)})


def read_checksummed(path: str) -> dict[str, Any]:
    """The object that `write_checksummed` wrote, without its checksum.

    Raises ValueError if the file is not a JSON object, has no checksum or another one.
    """
    content = storage.read_json(path)
    if not isinstance(content, dict):
        raise ValueError(f"it holds a {type(content).__name__}, expected an object")
    found = content.pop(CHECKSUM_KEY, None)
    if found is None:
        raise ValueError(
            f"it has no entry {CHECKSUM_KEY!r}, so another program or a version before 0.2 wrote it"
        )
    if found != checksum_of(content):
        raise ValueError(f"its content does not match its {CHECKSUM_KEY}")
    return content


def checksum_of(content: dict[str, Any]) -> str:
    """SHA-256 of the object as a reader gets it, independent of the order of its entries."""
    read_back = json.loads(json.dumps(content))
    canonical = json.dumps(read_back, sort_keys=True, separators=(",", ":"))
    return CHECKSUM_PREFIX + hashlib.sha256(canonical.encode()).hexdigest()


def from_json(kind: type[T], value: object) -> T:
    """The dataclass `kind` from decoded JSON, with the type of every field checked.

    Types are strict: no text for a number, no whole number with a decimal point, no missing and no
    unknown fields, no NaN and no infinity, no text that is not UTF-8.

    Raises ValueError that names the field, the value found and the one expected.
    """
    text = json.dumps([value])
    try:
        validated: tuple[T] = _adapter(cast(Any, kind)).validate_json(text)
    except ValidationError as error:
        raise ValueError(_message(kind.__name__, value, error)) from None
    return validated[0]


def is_file_name(name: str) -> bool:
    """Whether a name is that of one visible file in a folder: joined to a path it leads nowhere
    else."""
    return (
        bool(name) and not name.startswith(".") and not set(name) & set("/\\\0") and is_utf8(name)
    )


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    # Around a tuple: a dataclass takes no settings from outside, but inherits those of what holds
    # it.
    config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    return TypeAdapter(tuple[kind], config=config)


def _message(name: str, value: object, error: ValidationError) -> str:
    """The first error as one sentence: field, value found, value expected."""
    first = error.errors(include_url=False, include_context=False)[0]
    steps = first["loc"][1:]
    if first["type"] == "json_invalid":
        path = _find_invalid_text(value, name)
        return f"{path} is not UTF-8 text" if path else f"{name} is nested too deeply"
    if first["type"] in ("missing", "unexpected_keyword_argument"):
        what = "no" if first["type"] == "missing" else "an unknown"
        return f"{_path(name, steps[:-1])} has {what} field {excerpt(steps[-1])}"
    expected = first["msg"].removeprefix("Input should be ")
    return f"{_path(name, steps)} is {excerpt(first['input'])}, expected {expected}"


def _path(name: str, steps: Sequence[int | str]) -> str:
    """A field's path in the object, `Manifest.shards[3].name`; a hostile, long name is cut."""
    return (name + "".join(f"[{s}]" if isinstance(s, int) else f".{s}" for s in steps))[:100]


def _find_invalid_text(value: object, path: str) -> str | None:
    """Path of the first text that cannot be written as UTF-8; for the name of a field, its
    object's."""
    if isinstance(value, str):
        return None if is_utf8(value) else path
    if isinstance(value, dict):
        if not all(map(is_utf8, value)):
            return path
        found = (_find_invalid_text(item, f"{path}.{key}"[:100]) for key, item in value.items())
    elif isinstance(value, list):
        found = (_find_invalid_text(item, f"{path}[{i}]"[:100]) for i, item in enumerate(value))
    else:
        return None
    return next(filter(None, found), None)
