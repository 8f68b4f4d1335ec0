"""Photos in formats that an optional library decodes: converted with it, named without it."""

import io
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.core.records import Rejection
from pipeline.images import optional_formats
from pipeline.images.decode import decode
from pipeline.images.optional_formats import convert_optional
from pipeline.locate.photo_files import read_photo_tags

TAKEN = "2026:11:24 09:30:05"


def picture() -> Image.Image:
    cells = np.random.default_rng(0).integers(0, 256, size=(6, 4, 3), dtype=np.uint8)
    return Image.fromarray(cells).resize((80, 120))


def jpeg() -> bytes:
    stream = io.BytesIO()
    picture().save(stream, "JPEG")
    return stream.getvalue()


@pytest.mark.parametrize(("name", "extra"), [("b.HEIC", "heif"), ("x/c.DNG", "raw")])
def test_optional_format_without_library_is_named(
    name: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(optional_formats, "find_spec", lambda module: None)
    rejection = convert_optional(name, b"II*\0 a raw file or a HEIF container")
    assert isinstance(rejection, Rejection)
    assert rejection.reason == f"format not decoded (.{name[-4:].lower().strip('.')})"
    assert f"pip install pvda[{extra}]" in rejection.found
    assert len(rejection.found) < 200


@pytest.mark.parametrize("name", ["a.jpg", "a.heic", "a.dng", "a.avif"])
def test_optional_format_jpeg_of_any_name_is_kept(name: str) -> None:
    assert convert_optional(name, jpeg()) == jpeg()


def test_optional_format_heif_keeps_pixels_and_time() -> None:
    pillow_heif = pytest.importorskip("pillow_heif", reason="needs the extra heif")
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x9003] = TAKEN
    stream = io.BytesIO()
    pillow_heif.from_pillow(picture()).save(stream, quality=95, exif=exif.tobytes())
    converted = convert_optional("b.HEIC", stream.getvalue())
    assert isinstance(converted, bytes)
    error = np.abs(decode(converted).astype(int) - np.asarray(picture()).astype(int))
    assert error.mean() < 5
    assert read_photo_tags(converted).taken_at == "2026-11-24T09:30:05"


def test_optional_format_raw_is_developed(monkeypatch: pytest.MonkeyPatch) -> None:
    pixels_HW3 = np.asarray(picture())

    class Raw:
        sizes = SimpleNamespace(width=80, height=120)

        def __enter__(self) -> "Raw":
            return self

        def __exit__(self, *_: Any) -> None: ...

        def postprocess(self, use_camera_wb: bool) -> Any:
            return pixels_HW3

    rawpy = ModuleType("rawpy")
    rawpy.imread = lambda stream: Raw()  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "rawpy", rawpy)
    monkeypatch.setattr(optional_formats, "find_spec", lambda module: module)
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x9003] = TAKEN
    converted = convert_optional("c.DNG", exif.tobytes().removeprefix(b"Exif\0\0"))
    assert isinstance(converted, bytes)
    assert (decode(converted) == pixels_HW3).all()
    assert read_photo_tags(converted).taken_at == "2026-11-24T09:30:05"
    assert isinstance(convert_optional("c.DNG", b"II*\0"), bytes), "a raw file without tags"
    whole = io.BytesIO()
    picture().save(whole, "TIFF")
    assert isinstance(convert_optional("c.NEF", whole.getvalue()), bytes)
    rejection = convert_optional("c.NEF", whole.getvalue()[:-1000])
    assert isinstance(rejection, Rejection)
    assert (rejection.reason, len(whole.getvalue())) == ("truncated image", 28_940)
    assert "bytes of a raw file whose pixels end at 28940" in rejection.found
    Raw.sizes = SimpleNamespace(width=20_000, height=20_000)
    rejection = convert_optional("c.DNG", b"II*\0")
    assert isinstance(rejection, Rejection)
    assert rejection.reason == "too many pixels"


@pytest.mark.parametrize("name", ["b.heic", "c.dng"])
def test_optional_format_damaged_file_is_rejected(name: str) -> None:
    module = "pillow_heif" if name == "b.heic" else "rawpy"
    pytest.importorskip(module, reason="needs the extras heif and raw")
    rejection = convert_optional(name, b"II*\0" + bytes(200))
    assert isinstance(rejection, Rejection)
    assert rejection.reason in {"not an image", "damaged image", "truncated image"}
