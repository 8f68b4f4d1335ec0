"""A shard -> its images with what is known of them, whoever packed it.

In: one tar, by name. Out: samples in their order.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pipeline import storage
from pipeline.foreign import facts_of
from pipeline.records import InputError, Split, View
from pipeline.tars import IMAGES, read_tar

OURS = {"key", "location", "view", "split", "geotag"}
"What the JSON of a shard of ours says at least."


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One image as a shard holds it."""

    key: str
    data: bytes
    "The encoded image."
    facts: dict[str, Any]
    "The JSON beside it; of shards that others made, what could be found out in its words."


def read_shard(shards: str, name: str, split: Split | None = None, view: View | None = None) -> Iterator[Sample]:
    """The samples of one tar in their order; what has no image is none.

    `split` and `view` are those of a tar that others made, whose samples do not say; of ours they are not needed. Raises
    InputError where the tar is cut off or hostile, or where the samples are another's and it was not said what they are.
    """
    path = storage.join(shards, f"{name}.tar")
    for key, members in read_tar(path):
        data = next((members[ending] for ending in IMAGES if ending in members), None)
        if data is None:
            continue
        said = _json(members.get("json"))
        if said.keys() >= OURS:
            yield Sample(key=key, data=data, facts=said)
            continue
        if split is None or view is None:
            raise InputError(
                f"{path} was not packed by jobs/make_shards.py: sample {key} has no JSON that says {', '.join(sorted(OURS))}; "
                "give its --split and --view, or pack its images with jobs/make_shards.py"
            )
        facts = facts_of(key, said, members.get("cls"), split, view)
        yield Sample(key=facts["key"], data=data, facts=facts)


def read_locations(shards: str, name: str) -> Iterator[str]:
    """The locations of one tar's samples, without reading its images."""
    for _, members in read_tar(storage.join(shards, f"{name}.tar"), ("json",)):
        yield json.loads(members["json"])["location"]


def _json(data: bytes | None) -> dict[str, Any]:
    """A JSON object; nothing where there is none or it is none."""
    try:
        said = json.loads(data or b"{}")
    except ValueError:
        return {}
    return said if isinstance(said, dict) else {}
