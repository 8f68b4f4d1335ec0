"""Shards that others made -> a manifest and metadata in this project's terms, so that they can be
embedded as they are.

In: a folder of tars in webdataset's layout without a manifest.json. Out: the manifest that packing
would have written, per sample the JSON that it would have written, and on the terminal what was
skipped or not found.
"""

import json
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import IO, Any, cast

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.integrity import HashingStream
from pipeline.core.progress import console, progress
from pipeline.core.records import (
    MISSING_WORDS,
    Split,
    View,
    escape_non_utf8,
    is_position,
    make_key,
)
from pipeline.shards.manifest import MANIFEST, Manifest, Shard
from pipeline.shards.tar_reader import ALL_SUFFIXES, IMAGE_SUFFIXES, read_members

EXTERNAL = "others"
"The source in the manifest's packing settings of shards that others made."
TAR_ENDINGS = (".tar", ".tar.gz", ".tgz")
ARCHIVE = re.compile(
    r"\.(tar(\.(gz|bz2|xz|zst|lz4|lzma|\d+|part\w*|crdownload))?|tgz|tbz2?|txz|tzst|zip|7z|rar)$",
    re.IGNORECASE,
)
"""Names of archives of any kind: those that are not TAR_ENDINGS, unfinished downloads among them,
are reported."""
LOCATIONS = ("location", "label", "class", "class_name", "class_id", "place", "place_id", "id")
"Fields of a sample's JSON that may name the place it shows, the most reliable first."
LATITUDES = ("lat", "latitude", "gps_latitude", "gpslatitude")
LONGITUDES = ("lon", "lng", "long", "longitude", "gps_longitude", "gpslongitude")
NESTED = ("geotag", "gps", "position", "location", "coordinates", "geolocation", "geometry")
"Fields that may hold an object with the position."
USED_FIELDS = frozenset(LOCATIONS + LATITUDES + LONGITUDES + NESTED)
WHOLE_FLOAT = re.compile(r"(-?\d+)\.0+")
"A whole number as a table with missing values writes it: 12.0 for 12."
OUR_NAMES = re.compile(rf"({'|'.join(Split)})-({'|'.join(View)})-")
"Tar names that state a split and a view."


@dataclass(kw_only=True)
class ScanReport:
    """What a scan of others' tars has to report, as counts."""

    images: int = 0
    without_position: int = 0
    fields: Counter[str] = field(default_factory=Counter)
    "Fields of the JSON of samples without a position."
    further_images: list[str] = field(default_factory=list)
    "Images beside another one of the same sample."
    without_image: list[str] = field(default_factory=list)
    "Keys of metadata without an image."
    skipped: Counter[str] = field(default_factory=Counter)
    "Endings of members that are neither images nor metadata."
    contradicting: list[str] = field(default_factory=list)
    "Samples whose JSON members state different values, with the fields."
    other_tars: list[str] = field(default_factory=list)
    "Tars whose names state another split or view."
    other_archives: list[str] = field(default_factory=list)
    "Archives of kinds that are not read, and tars in folders below."

    def add(self, key: str, members: Mapping[str, bytes], images: list[str]) -> None:
        """Count one sample."""
        self.images += 1
        self.further_images += [f"{key}.{suffix}" for suffix in images[1:]]
        stated, _ = find_metadata(members)
        if fields := [name for name in merge_json(members)[1] if name.lower() in USED_FIELDS]:
            self.contradicting.append(f"{key}: {', '.join(fields)}")
        if find_position(stated) is None:
            self.without_position += 1
            self.fields.update(stated.keys())

    def sentences(self) -> Iterator[str]:
        """A sentence for each thing that was skipped or not found."""
        if self.without_position:
            names = ", ".join(sorted(name for name, _ in self.fields.most_common(8)))
            there = f"its fields are {names}" if names else "they have none"
            yield (
                f"{self.without_position} of {self.images} images: no position found in their "
                f"JSON ({there})"
            )
        for listed, what in (
            (self.further_images, "further images of a sample were left out"),
            (self.without_image, "samples have no image and were left out"),
            (
                self.contradicting,
                "samples have JSON members that contradict each other in fields, now ignored",
            ),
            (self.other_tars, "tars whose names state another split or view were left out"),
            (
                self.other_archives,
                "archives were left out, as only .tar, .tar.gz and .tgz in this folder are read",
            ),
        ):
            if listed:
                more = ", ..." if len(listed) > 3 else ""
                yield f"{len(listed)} {what} ({', '.join(listed[:3])}{more})"
        if self.skipped:
            endings = ", ".join(f"{count} {name}" for name, count in self.skipped.most_common(5))
            yield f"{self.skipped.total()} members of other kinds were left out ({endings})"


def scan_tars(
    folder: str, tars: list[str], split: Split, view: View, others: Sequence[str] = ()
) -> Manifest:
    """A manifest of the tars of this split and view: all but those whose names state another.

    `others`: archives in the folder that are not read, for the report.
    Raises InputError where two samples have one key, and as `read_tar` does.
    """
    console.print(
        f"{folder} has no {MANIFEST}: reading {len(tars)} tars as shards that others made, "
        f"{split} {view}"
    )
    found: list[Shard] = []
    files: dict[str, str] = {}
    scattered: list[str] = []
    seen: dict[str, str] = {}  # key -> the tar that holds it
    report = ScanReport(other_archives=list(others))
    with progress(len(tars), "reading", "tars") as meter:
        for file in tars:
            if (stated := OUR_NAMES.match(file)) and stated.groups() != (split, view):
                report.other_tars.append(file)
                continue
            name = file.removesuffix(next(end for end in TAR_ENDINGS if file.endswith(end)))
            if file != f"{name}.tar":
                name = f"{name}-gz" if f"{name}.tar" in tars else name
                files[name] = file
            before, path = report.images, storage.join(folder, file)
            with storage.open_read(path) as stream:
                hashed = HashingStream(stream)
                if _scan_tar(hashed, path, seen, report):
                    scattered.append(name)
                hashed.drain()
            found.append(
                Shard(
                    name=name, split=split, view=view, samples=report.images - before,
                    **asdict(hashed.checksum),
                )
            )  # fmt: skip
            meter.advance(samples=report.images)
    for sentence in report.sentences():
        console.print(f"{folder}: {sentence}", style="yellow")
    packing = {"source": EXTERNAL, "files": files, "scattered": scattered}
    return Manifest(shards=tuple(found), classes=(), packing=packing, rejected=0)


def _scan_tar(stream: HashingStream, path: str, seen: dict[str, str], report: ScanReport) -> bool:
    """Count the samples of one tar; returns whether metadata stands apart from its image."""
    apart: dict[str, dict[str, bytes]] = {}
    bare: dict[str, tuple[dict[str, bytes], list[str]]] = {}
    members_of = read_members(
        cast(IO[bytes], stream), path, ALL_SUFFIXES, external=True, skipped=report.skipped
    )
    for key, members in members_of:
        images = find_suffixes(members, IMAGE_SUFFIXES)
        if not images:
            apart.setdefault(key, {}).update(members)
            continue
        if key in seen:
            folder, _, file = path.rpartition("/")
            raise InputError(
                f"sample {key} is in {seen[key]} and again in {file} of {folder}, expected keys "
                "that are unique over the set; embed these tars from folders of their own, or "
                "give the samples other keys"
            )
        seen[key] = path.rpartition("/")[2]
        if len(members) == len(images):
            bare[key] = dict.fromkeys(members, b""), images
        else:
            report.add(key, members, images)
    for key, (members, images) in bare.items():
        report.add(key, apart.get(key, {}) | members, images)
    report.without_image += sorted(apart.keys() - bare.keys())
    return bool(apart.keys() & bare.keys())


def find_suffixes(members: Mapping[str, bytes], endings: tuple[str, ...]) -> list[str]:
    """The suffixes of a sample's members with these endings: plain ones (`jpg`) in the order of
    `endings`, then those with dots (`rgb.jpg`) in the order of the tar.
    """
    dotted = [suffix for suffix in members if suffix.rpartition(".")[2] in endings]
    plain = [ending for ending in endings if ending in members]
    return plain + [suffix for suffix in dotted if suffix not in plain]


def find_metadata(members: Mapping[str, bytes]) -> tuple[dict[str, Any], bytes | None]:
    """A sample's JSON objects as one, without the fields that they contradict each other in, and
    its label.
    """
    stated, contradictions = merge_json(members)
    labels = find_suffixes(members, ("cls",))
    kept = {name: value for name, value in stated.items() if name not in contradictions}
    return kept, members[labels[0]] if labels else None


def merge_json(members: Mapping[str, bytes]) -> tuple[dict[str, Any], list[str]]:
    """The fields of all JSON objects of a sample, and the names of those with several values."""
    objects = [parse_json(members[suffix]) for suffix in find_suffixes(members, ("json",))]
    merged: dict[str, Any] = {}
    contradictions = []
    for stated in objects:  # compared as text, since NaN is not equal to itself
        contradictions += [
            name for name in stated if name in merged and repr(stated[name]) != repr(merged[name])
        ]
        merged = stated | merged
    return merged, contradictions


def external_metadata(
    key: str, stated: Mapping[str, Any], label: bytes | None, split: Split, view: View
) -> dict[str, Any]:
    """The JSON that packing would have written for a sample, from its key, its JSON and its `.cls`.

    The location is the JSON's first field of LOCATIONS, else the label, else the key's folder, else
    the key, so that every image is a location of its own.
    """
    folder, _, _ = key.rpartition("/")
    named = next(filter(None, (_name(stated.get(name)) for name in LOCATIONS)), "")
    location = named or _name((label or b"").decode(errors="replace"))
    location = location or folder.rpartition("/")[2] or key
    location = escape_non_utf8(location)  # JSON and names of files may hold half a character
    return {
        "key": make_key(split, view, location, key),
        "location": location,
        "view": view,
        "split": split,
        "geotag": find_position(stated),
        "source": EXTERNAL,
    }


def _name(value: object) -> str:
    """A location's name from text or a number, 12 for 12.0; empty where it is none, or a word for
    a missing value.
    """
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        return ""
    text = str(value).strip()
    if text.lower() in MISSING_WORDS:
        return ""
    whole = WHOLE_FLOAT.fullmatch(text)
    return whole[1] if whole else text


def find_position(stated: Mapping[str, Any], depth: int = 0) -> dict[str, float] | None:
    """The position in a JSON: numbers, also as text, at the top level, as a GeoJSON point, or in an
    object of NESTED; None where there is none. Names of fields may have capitals.
    """
    lowered = {str(name).lower(): value for name, value in stated.items()}
    lat, lon = (
        next((number for name in names if (number := _number(lowered.get(name))) is not None), None)
        for names in (LATITUDES, LONGITUDES)
    )
    corners = lowered.get("coordinates")
    if lowered.get("type") == "Point" and isinstance(corners, list) and len(corners) >= 2:
        lon, lat = _number(corners[0]), _number(corners[1])
    if is_position(lat, lon):
        return {"lat": float(cast(float, lat)), "lon": float(cast(float, lon))}
    nested = (lowered.get(name) for name in NESTED if depth < 3)
    positions = (find_position(one, depth + 1) for one in nested if isinstance(one, dict))
    return next((position for position in positions if position), None)


def _number(value: object) -> float | None:
    """A number, also as text with a decimal point or comma; None where it is none."""
    if isinstance(value, str):
        try:
            value = float(value.strip().replace(",", "."))
        except ValueError:
            return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return value if isinstance(value, int) or math.isfinite(value) else None


def parse_json(data: bytes | None) -> dict[str, Any]:
    """A JSON object, perhaps alone in a list; empty where the bytes are none."""
    try:
        stated = json.loads(data or b"{}")
    except (ValueError, RecursionError):
        return {}
    if isinstance(stated, list) and len(stated) == 1:
        [stated] = stated
    return stated if isinstance(stated, dict) else {}
