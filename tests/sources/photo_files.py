"""Photos with camera tags for tests."""

from pathlib import Path
from typing import Any

from PIL import Image

from pipeline.core.records import ImageRecord, Scanned
from pipeline.sources.photos import Photos

HERE = {1: "S", 2: (33.0, 30.0, 0.0), 3: "W", 4: (70.0, 45.0, 0.0)}
"33.5 south, 70.75 west"
FLOWN = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/">'
    b'<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    b'<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" '
    b'drone-dji:RelativeAltitude="+100.00" drone-dji:GimbalYawDegree="+90.00" '
    b'drone-dji:GimbalPitchDegree="-45.00"/></rdf:RDF></x:xmpmeta>'
)


def photo(
    path: Path,
    gps: dict[int, Any] | None = None,
    lens: dict[int, Any] | None = None,
    **options: Any,
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif.get_ifd(0x8825).update(gps or {})
    exif.get_ifd(0x8769).update({0x9003: "2024:05:01 12:34:56"} | (lens or {}))
    kind = {".png": "PNG", ".webp": "WEBP", ".tif": "TIFF"}.get(path.suffix.lower(), "JPEG")
    Image.new("RGB", (16, 12), "green").save(path, kind, exif=exif, **options)


def scan(root: Path, **changes: Any) -> dict[str, Scanned]:
    found = {
        found.path.removeprefix(f"{root}/"): found for found in Photos(**changes).scan(str(root))
    }
    assert list(found) == sorted(found), "an order of names alone"
    return found


def records(root: Path, **changes: Any) -> dict[str, ImageRecord]:
    found = scan(root, **changes)
    assert all(isinstance(record, ImageRecord) for record in found.values()), found
    return found  # type: ignore[return-value]
