"""Settings as a file: what `--print-config` prints, and what `--config FILE` reads.

In: the arguments of a job's function. Out: YAML with one entry per flag, and from such a file the
words of a command line. So a file can say what flags can, flags given beside it come later and win,
and one parser validates both.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from typing import Any, get_args, get_type_hints

import tyro

from pipeline.core import storage
from pipeline.core.errors import InputError

POSITIONAL: Any = tyro.conf.Positional
"tyro's mark of an argument without a flag."


@dataclass(frozen=True, kw_only=True)
class Choice:
    """A word of the command line that decides which further flags exist."""

    name: str
    "Of the parameter: `recipe`, `source`."
    names: tuple[str, ...]
    "The words to choose from."
    name_of: Callable[[Any], str]
    "The word for a parsed value."
    kind_of: Callable[[str], type[Any]] | None = None
    """The settings that `--NAME WORD` adds; None where the word is a subcommand, the command line's
    first word."""
    help: str = ""
    "Of the flag, where no word was given."


def flatten(
    values: Mapping[str, Any], hints: Mapping[str, Any], choice: Choice | None = None
) -> dict[str, Any]:
    """One entry per flag; fields of nested settings stand beside the others, since flags have no
    prefixes."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        spec = _primitive_spec(hints.get(name))
        if choice is not None and name == choice.name and value is not None:
            flat[name] = choice.name_of(value)
        if spec is not None:
            flat[name] = None if value is None else spec.str_from_instance(value)
        elif is_dataclass(value) and not isinstance(value, type):
            flat |= flatten_settings(value, choice)
        elif choice is None or name != choice.name:
            flat[name] = _plain(value)
    return flat


def flatten_settings(settings: Any, choice: Choice | None = None) -> dict[str, Any]:
    """One entry per flag of a settings dataclass."""
    values = {field.name: getattr(settings, field.name) for field in fields(settings)}
    return flatten(values, get_type_hints(type(settings), include_extras=True), choice)


def to_yaml(flat: Mapping[str, Any]) -> str:
    """The file's text; entries are named as flags are."""
    import yaml

    entries = {name.replace("_", "-"): value for name, value in flat.items()}
    return str(yaml.safe_dump(entries, sort_keys=False, allow_unicode=True))


def read_config(
    path: str, job: Callable[..., Any], choice: Choice | None
) -> tuple[str | None, list[str]]:
    """The choice's word, if the file has one, and the words of a command line that say the rest.

    Raises InputError.
    """
    import yaml

    try:
        entries = yaml.safe_load(storage.read_bytes(path).decode())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"{path} cannot be read as settings ({reason}), expected YAML with one entry per flag; "
            "see --print-config"
        ) from None
    if not isinstance(entries, dict) or not all(isinstance(name, str) for name in entries):
        raise InputError(
            f"{path} has no entries with names, expected one per flag; see --print-config"
        )
    positional = _positional_names(job)
    word, arguments, words = None, list[str](), list[str]()
    for name, value in entries.items():
        field = name.replace("-", "_")
        if choice is not None and field == choice.name:
            word = str(value)
        elif field in positional:
            arguments += _strings(value)
        elif isinstance(value, bool):
            words.append(f"--{name}" if value else f"--no-{name}")
        else:
            words += [f"--{name}", *_strings(value)]
    return word, arguments + words


def _strings(value: Any) -> list[str]:
    return [str(one) for one in value] if isinstance(value, list) else [str(value)]


def _plain(value: Any) -> Any:
    """A value as YAML has it: an enum's value, a list for a tuple."""
    if isinstance(value, Enum):
        return value.value
    return [_plain(one) for one in value] if isinstance(value, tuple | list) else value


def _primitive_spec(hint: Any) -> Any:
    """What a hint names to parse its value from words; None where it names nothing."""
    kind = tyro.constructors.PrimitiveConstructorSpec
    return next((mark for mark in get_args(hint) if isinstance(mark, kind)), None)


def _positional_names(job: Callable[..., Any]) -> set[str]:
    """Parameters of a job, and fields of its settings, that have no flag."""
    names, waiting = set[str](), [get_type_hints(job, include_extras=True)]
    while waiting:
        for name, hint in waiting.pop().items():
            marks = getattr(hint, "__metadata__", ())
            kind = get_args(hint)[0] if marks else hint
            if POSITIONAL in marks:
                names.add(name)
            elif isinstance(kind, type) and is_dataclass(kind):
                waiting.append(get_type_hints(kind, include_extras=True))
    return names
