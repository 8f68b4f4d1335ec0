"""A folder that a simulation writes: whether it is new, begun, complete, or something else.

A run keeps its settings in `.parts/settings.json` until its last file, which has them too.
"""

from collections.abc import Collection
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pipeline.core import json_files, storage
from pipeline.core.errors import InputError

BEGUN = Path(".parts") / "settings.json"


def local_root(out: str) -> Path:
    """The folder of a simulation, absolute. Raises InputError where it is not local or mounted."""
    if not storage.is_local(out):
        raise InputError(
            f"--out is {out}, expected a local or mounted folder; write it there and copy it"
        )
    return Path(storage.resolve(out)[1]).absolute()


def settings_record(settings: Any, left_out: Collection[str]) -> dict[str, Any]:
    """A dataclass of settings as JSON gives it back, without those that change no output."""
    kept = {name: value for name, value in asdict(settings).items() if name not in left_out}
    return {
        name: list(value) if isinstance(value, tuple) else value for name, value in kept.items()
    }


def is_complete(root: Path, metadata: dict[str, Any], last: str, what: str, job: str) -> bool:
    """Whether the folder holds the complete output of these settings, its file `last` with them.

    `what`: the output in words; `job`: the script that makes it. Raises InputError if the folder
    holds the output of other settings, or something else.
    """
    complete, started = root / last, root / BEGUN
    path = complete if complete.exists() else started
    if not path.exists():
        if root.exists() and any(root.iterdir()):
            raise InputError(
                f"{root} holds files that no simulation wrote, expected a new or empty folder; "
                "choose another --out"
            )
        return False
    try:
        found = json_files.read_checksummed(str(path))
    except ValueError as error:
        raise InputError(
            f"{path} is damaged ({error}), expected the settings of a simulation; "
            f"remove {root} and run {job} again"
        ) from None
    differing = [
        f"{name} {found.get(name)!r} instead of {metadata.get(name)!r}"
        for name in sorted({*found, *metadata})
        if found.get(name) != metadata.get(name)
    ]
    if differing:
        raise InputError(
            f"{root} holds {what} made with {', '.join(differing)}, expected the same settings "
            "to resume; choose another --out or remove the folder"
        )
    return path == complete


def begin(root: Path, metadata: dict[str, Any]) -> None:
    """Keep the settings of a run that begins or goes on."""
    (root / BEGUN).parent.mkdir(parents=True, exist_ok=True)
    json_files.write_checksummed(str(root / BEGUN), metadata)
