"""JSON that decides what is done, with a seal: the hash of all else that it says.

In: an object and a path. Out: a file that anybody reads as JSON, and back from it the object, or an error where it says
something else than was written. A file without a seal, written before there were any, is believed as it is.
"""

import hashlib
import json
from typing import Any

from pipeline import storage

SEAL, KIND = "seal", "sha256:"
"Name and beginning of the last entry."


def write(path: str, said: dict[str, Any]) -> None:
    """Write an object as a JSON file with its seal, whole or not at all."""
    storage.write_json(path, said | {SEAL: seal_of(said)})


def read(path: str) -> dict[str, Any]:
    """The object without its seal.

    Raises ValueError where the file is no JSON object or not what was written.
    """
    said = storage.read_json(path)
    if not isinstance(said, dict):
        raise ValueError(f"{type(said).__name__} in place of an object")
    seal = said.pop(SEAL, None)
    # A seal under another name is one whose name was damaged.
    sealed = seal is not None or any(isinstance(value, str) and value.startswith(KIND) for value in said.values())
    if sealed and seal != seal_of(said):
        raise ValueError(f"its {SEAL!r} is not of what it says; whoever changed it on purpose takes that entry out")
    return said


def seal_of(said: dict[str, Any]) -> str:
    """The hash of what reading the object back would give, whatever the order of its entries."""
    read_back = json.loads(json.dumps(said))
    plain = json.dumps(read_back, sort_keys=True, separators=(",", ":"))
    return KIND + hashlib.sha256(plain.encode()).hexdigest()
