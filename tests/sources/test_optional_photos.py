"""HEIC and raw photos are packed where their extras are installed, with the camera's tags."""

import io
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.core.arrays import Pixels
from pipeline.core.records import ImageRecord, Rejection, SkippedFile
from pipeline.images import optional_formats
from pipeline.images.decode import decode
from pipeline.images.image_blocks import find_metadata
from pipeline.images.inspect import IMAGE_SUFFIXES
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.shards.shard_set import open_shards
from pipeline.sources.photos import Photos
from pipeline.sources.table import Table
from tests.sources.photo_files import FLOWN, HERE, photo, scan

HEIC = b"\0\0\0\x18ftypheic"
"How a HEIF file begins."


def developed() -> Pixels:
    """What both made libraries decode."""
    cells = np.random.default_rng(5).integers(0, 256, size=(6, 4, 3), dtype=np.uint8)
    return np.asarray(Image.fromarray(cells).resize((80, 120)))


def exif_block(folder: Path) -> bytes:
    """The EXIF block of a made photo, a TIFF structure."""
    photo(folder / "made.jpg", HERE)
    block = find_metadata((folder / "made.jpg").read_bytes(), complete=True).exif
    (folder / "made.jpg").unlink()
    assert block is not None
    return block


@pytest.fixture
def extras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stand-ins for pillow-heif and rawpy, with the tags of a made photo."""
    block = exif_block(tmp_path)

    def open_heif(stream: io.BytesIO, **_: Any) -> Any:
        if not stream.getvalue().startswith(HEIC):
            raise ValueError("not a HEIF file")
        image = Image.fromarray(developed())
        info = {"exif": b"Exif\0\0" + block, "xmp": FLOWN}
        return SimpleNamespace(size=image.size, info=info, to_pillow=lambda: image)

    class Raw:
        sizes = SimpleNamespace(width=80, height=120)

        def __enter__(self) -> "Raw":
            return self

        def __exit__(self, *_: Any) -> None: ...

        def postprocess(self, use_camera_wb: bool) -> Pixels:
            return developed()

    pillow_heif, rawpy = ModuleType("pillow_heif"), ModuleType("rawpy")
    pillow_heif.open_heif = open_heif  # type: ignore[attr-defined]
    rawpy.imread = lambda stream: Raw()  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "pillow_heif", pillow_heif)
    monkeypatch.setitem(sys.modules, "rawpy", rawpy)
    monkeypatch.setattr(optional_formats, "find_spec", lambda module: module)


def raw_file(path: Path) -> None:
    """A raw file as far as its tags go: a TIFF with EXIF and GPS directories."""
    path.write_bytes(exif_block(path.parent))


@pytest.mark.usefixtures("extras")
def test_heic_and_raw_photos_are_packed_as_png(tmp_path: Path) -> None:
    root = tmp_path / "card"
    root.mkdir()
    (root / "IMG_1.HEIC").write_bytes(HEIC)
    raw_file(root / "DJI_2.DNG")
    photo(root / "DJI_3.jpg", HERE)
    settings = PackingSettings(root=str(root), out=str(tmp_path / "shards"), workers=0)
    manifest = pack(Photos(location="file"), settings)
    assert (sum(shard.samples for shard in manifest.shards), manifest.rejected) == (3, 0)
    shards = open_shards(str(tmp_path / "shards"))
    [shard] = shards.manifest.shards
    found = {sample.metadata["location"]: sample for sample in shards.samples(shard, verify=True)}
    for name, height in (("IMG_1", 100), ("DJI_2", None)):
        sample = found[name]
        tag = sample.metadata["geotag"]
        assert (tag["lat"], tag["lon"], tag["altitude_m"]) == (-33.5, -70.75, height)
        assert sample.metadata["taken_at"] == "2024-05-01T12:34:56"
        assert sample.data.startswith(b"\x89PNG")
        assert (decode(sample.data) == developed()).all()
    assert not found["DJI_3"].data.startswith(b"\x89PNG"), "the photo's own bytes"


@pytest.mark.usefixtures("extras")
def test_damaged_heic_is_refused_by_packing(tmp_path: Path) -> None:
    photo(tmp_path / "a.jpg", HERE)
    (tmp_path / "b.heic").write_bytes(b"no HEIF at all")
    found = scan(tmp_path)
    assert isinstance(found["b.heic"], ImageRecord)
    settings = PackingSettings(
        root=str(tmp_path), out=f"{tmp_path}/out", workers=0, max_bad_fraction=1
    )
    assert pack(Photos(), settings).rejected == 1


@pytest.mark.usefixtures("extras")
def test_raw_copies_of_photos_are_passed_over(tmp_path: Path) -> None:
    for name in ("1.jpg", "2.heic"):
        photo(tmp_path / name, HERE)
    for name in ("1.dng", "2.DNG", "3.CR2"):
        raw_file(tmp_path / name)
    found = scan(tmp_path)
    assert {name for name, one in found.items() if isinstance(one, SkippedFile)} == {
        "1.dng",
        "2.DNG",
    }
    assert isinstance(found["3.CR2"], ImageRecord)
    assert isinstance(found["2.heic"], ImageRecord), "a JPEG under the name of a HEIF"


@pytest.mark.usefixtures("extras")
def test_table_takes_heic_and_names_other_formats(tmp_path: Path) -> None:
    for name in ("a.heic", "b.jxl", "c.txt"):
        (tmp_path / name).write_bytes(HEIC)
    (tmp_path / "t.csv").write_text("path\na.heic\nb.jxl\nc.txt\n")
    first, second, third = Table().scan(str(tmp_path / "t.csv"))
    assert isinstance(first, ImageRecord)
    assert Table().ending(first) == "png"
    assert [one.reason for one in (second, third) if isinstance(one, Rejection)] == [
        "format not decoded (.jxl)",
        "not an image's name",
    ]


def test_endings_of_optional_formats_are_none_of_images() -> None:
    suffixes = [suffix for names, _ in optional_formats.EXTRAS.values() for suffix in names]
    assert not set(suffixes) & set(IMAGE_SUFFIXES)
    assert all(optional_formats.extra_for(f"A{suffix.upper()}") for suffix in suffixes)
