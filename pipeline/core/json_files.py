"""What a JSON file says -> a dataclass of ours, every type looked at.

In: decoded JSON. Out: the dataclass, or a ValueError that says which field is not what it should
be. Whoever reads on may rely on it: a file may come from anybody, and Python would take a list
where a number is meant until somebody computes with it.
"""

import dataclasses
import hashlib
import json
import types
import typing
from enum import StrEnum
from typing import Any, TypeVar, cast, get_args, get_origin

from pipeline.core import storage
from pipeline.core.records import excerpt, is_utf8

Told = TypeVar("Told")


def from_json(kind: type[Told], said: object) -> Told:
    """The dataclass `kind` from a JSON object with its fields by name. Raises ValueError."""
    return cast(Told, _value(kind, said, kind.__name__))


def is_file_name(name: str) -> bool:
    """Whether a name is one file's in a folder: it leads nowhere else, whatever joins it to a path."""
    return (
        bool(name) and not name.startswith(".") and not set(name) & set("/\\\0") and is_utf8(name)
    )


def _value(kind: Any, said: object, name: str) -> object:
    """`said` as a value of a type that dataclasses of ours have."""
    origin, inner = get_origin(kind), get_args(kind)
    if kind is Any:
        return said
    if dataclasses.is_dataclass(kind):
        return _dataclass(kind, said, name)
    if origin in (types.UnionType, typing.Union):
        rest = [one for one in inner if one is not types.NoneType]
        return None if said is None and len(rest) < len(inner) else _value(rest[0], said, name)
    if origin is typing.Literal and isinstance(said, str | int) and said in inner:
        return said
    if origin is tuple and isinstance(said, list):
        kinds = [inner[0]] * len(said) if inner[-1] is Ellipsis else list(inner)
        if len(kinds) == len(said):
            return tuple(
                _value(one, value, f"{name}[{at}]")
                for at, (one, value) in enumerate(zip(kinds, said, strict=True))
            )
    if origin is dict and isinstance(said, dict):
        return {key: _value(inner[1], value, f"{name}[{key!r}]") for key, value in said.items()}
    if (
        isinstance(kind, type)
        and issubclass(kind, StrEnum)
        and isinstance(said, str)
        and said in list(kind)
    ):
        return kind(said)
    if kind is float and type(said) in (int, float):
        return float(cast(float, said))  # OverflowError: a whole number beyond all floats
    if (
        kind in (int, bool, str)
        and type(said) is kind
        and (kind is not str or is_utf8(cast(str, said)))
    ):
        return said
    raise ValueError(f"{name[:100]} is {excerpt(said)}, expected {getattr(kind, '__name__', kind)}")


def _dataclass(kind: Any, said: object, name: str) -> object:
    if not isinstance(said, dict):
        raise ValueError(f"{name} is {excerpt(said)}, expected an object")
    fields = {field.name: field for field in dataclasses.fields(kind)}
    optional = {
        field.name
        for field in fields.values()
        if field.default is not dataclasses.MISSING
        or field.default_factory is not dataclasses.MISSING
    }
    missing, strange = (
        sorted(fields.keys() - said.keys() - optional),
        sorted(said.keys() - fields.keys()),
    )
    if missing or strange:
        raise ValueError(
            f"{name} has {'no' if missing else 'a strange'} field {excerpt((missing or strange)[0])}"
        )
    hints = typing.get_type_hints(kind)
    return kind(
        **{field: _value(hints[field], value, f"{name}.{field}") for field, value in said.items()}
    )


CHECKSUM_KEY, CHECKSUM_PREFIX = "seal", "sha256:"
"Name and beginning of the last entry."


def write_checksummed(path: str, said: dict[str, Any]) -> None:
    """Write an object as a JSON file with its seal, whole or not at all."""
    storage.write_json(path, said | {CHECKSUM_KEY: checksum_of(said)})


def read_checksummed(path: str) -> dict[str, Any]:
    """The object without its seal.

    Raises ValueError where the file is no JSON object or not what was written.
    """
    said = storage.read_json(path)
    if not isinstance(said, dict):
        raise ValueError(f"{type(said).__name__} in place of an object")
    seal = said.pop(CHECKSUM_KEY, None)
    # A seal under another name is one whose name was damaged.
    sealed = seal is not None or any(
        isinstance(value, str) and value.startswith(CHECKSUM_PREFIX) for value in said.values()
    )
    if sealed and seal != checksum_of(said):
        raise ValueError(
            f"its {CHECKSUM_KEY!r} is not of what it says; whoever changed it on purpose takes that entry out"
        )
    return said


def checksum_of(said: dict[str, Any]) -> str:
    """The hash of what reading the object back would give, whatever the order of its entries."""
    read_back = json.loads(json.dumps(said))
    plain = json.dumps(read_back, sort_keys=True, separators=(",", ":"))
    return CHECKSUM_PREFIX + hashlib.sha256(plain.encode()).hexdigest()
