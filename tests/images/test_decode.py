"""Decoding against Pillow, and orientation against pictures whose every pixel is known.

Shapes: H x W pixels.
"""

import io
import struct
import zlib
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageOps

from pipeline.core.arrays import Pixels
from pipeline.images.decode import DecodeError, decode


def noise(height: int = 37, width: int = 50) -> Pixels:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def encoded(image: Image.Image, form: str, **options: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, form, **options)
    return buffer.getvalue()


PHOTO = Image.fromarray(noise())
FORMS = {
    "jpeg": encoded(PHOTO, "JPEG"),
    "jpeg of full colour": encoded(PHOTO, "JPEG", subsampling=0, quality=95),
    "jpeg of half colour": encoded(PHOTO, "JPEG", subsampling=1),
    "progressive jpeg": encoded(PHOTO, "JPEG", progressive=True),
    "grey jpeg": encoded(PHOTO.convert("L"), "JPEG"),
    "cmyk jpeg": encoded(PHOTO.convert("CMYK"), "JPEG"),
    "png": encoded(PHOTO, "PNG"),
    "grey png": encoded(PHOTO.convert("L"), "PNG"),
    "black and white png": encoded(PHOTO.convert("1"), "PNG"),
    "palette png": encoded(PHOTO.convert("P"), "PNG"),
    "rgba png": encoded(PHOTO.convert("RGBA"), "PNG"),
    "grey png with alpha": encoded(PHOTO.convert("LA"), "PNG"),
    "gif": encoded(PHOTO.convert("P"), "GIF"),
    "bmp": encoded(PHOTO, "BMP"),
    "tiff": encoded(PHOTO, "TIFF", compression="tiff_lzw"),
    "webp": encoded(PHOTO, "WEBP", lossless=True),
}


@pytest.mark.parametrize("data", FORMS.values(), ids=FORMS)
def test_decode_gives_pillows_pixels(data: bytes) -> None:
    found_HW3 = decode(data)
    assert found_HW3.dtype == np.uint8
    with Image.open(io.BytesIO(data)) as image:
        assert np.array_equal(found_HW3, np.asarray(image.convert("RGB")))


def test_decode_of_a_transparent_palette_does_not_warn() -> None:
    data = encoded(PHOTO.convert("P"), "PNG", transparency=bytes([0, 128] * 20))
    assert np.array_equal(decode(data), np.asarray(PHOTO.convert("P").convert("RGB")))


@pytest.mark.parametrize("form", ["PNG", "TIFF"])
def test_decode_of_16_bits_keeps_the_upper_8(form: str) -> None:
    deep_HW = np.array([[0, 255, 256], [0x1234, 0x80FF, 0xFFFF]], np.uint16)
    found_HW3 = decode(encoded(Image.fromarray(deep_HW), form))
    assert found_HW3.dtype == np.uint8
    for channel in range(3):
        assert found_HW3[:, :, channel].tolist() == [[0, 0, 1], [0x12, 0x80, 0xFF]]


A, B, C, D, E, F = ((value, value, value) for value in (10, 50, 90, 130, 170, 210))
STORED = [[A, B, C], [D, E, F]]
UPRIGHT = {
    1: [[A, B, C], [D, E, F]],
    2: [[C, B, A], [F, E, D]],  # mirrored
    3: [[F, E, D], [C, B, A]],  # upside down
    4: [[D, E, F], [A, B, C]],
    5: [[A, D], [B, E], [C, F]],
    6: [[D, A], [E, B], [F, C]],  # to be turned clockwise
    7: [[F, C], [E, B], [D, A]],
    8: [[C, F], [B, E], [A, D]],  # to be turned anticlockwise
}


def exif(orientation: int) -> Image.Exif:
    tags = Image.Exif()
    tags[0x0112] = orientation
    return tags


@pytest.mark.parametrize("orientation", UPRIGHT)
@pytest.mark.parametrize(
    ("form", "mode"), [("PNG", "RGB"), ("PNG", "P"), ("TIFF", "RGB"), ("WEBP", "RGB")]
)
def test_decode_turns_an_image_upright(orientation: int, form: str, mode: str) -> None:
    stored = Image.fromarray(np.array(STORED, np.uint8))
    if mode == "P":
        stored = stored.quantize(6)  # as many colours as it has
    options = {"lossless": True} if form == "WEBP" else {}
    data = encoded(stored, form, exif=exif(orientation), **options)
    assert np.array_equal(decode(data), np.array(UPRIGHT[orientation], np.uint8))


@pytest.mark.parametrize("orientation", UPRIGHT)
def test_decode_turns_a_jpeg_upright(orientation: int) -> None:
    large_HW3 = np.kron(np.array(STORED, np.uint8), np.ones((16, 16, 1), np.uint8))  # JPEG's blocks
    found_HW3 = decode(
        encoded(Image.fromarray(large_HW3), "JPEG", quality=95, exif=exif(orientation))
    )
    expected_HW3 = np.array(UPRIGHT[orientation], np.int64)
    assert np.abs(found_HW3[8::16, 8::16] - expected_HW3).max() <= 2


@pytest.mark.parametrize("orientation", UPRIGHT)
@pytest.mark.parametrize(
    ("mode", "form", "options"),
    [
        ("RGB", "JPEG", {}),
        ("RGB", "JPEG", {"progressive": True}),
        ("L", "JPEG", {}),
        ("CMYK", "JPEG", {}),
        (
            "RGB",
            "MPO",
            {"save_all": True, "append_images": [PHOTO.resize((20, 20))]},
        ),  # a JPEG that another follows
    ],
)
def test_decode_of_a_turned_photo_gives_pillows_pixels(
    orientation: int, mode: str, form: str, options: dict[str, object]
) -> None:
    data = encoded(PHOTO.convert(mode), form, exif=exif(orientation), **options)
    with Image.open(io.BytesIO(data)) as image:
        assert image.format == form
        expected_HW3 = np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
    found_HW3 = decode(data)
    assert np.array_equal(found_HW3, expected_HW3)
    assert found_HW3.flags.c_contiguous


@pytest.mark.parametrize("orientation", [0, 9, 255])
def test_decode_ignores_an_orientation_without_meaning(orientation: int) -> None:
    data = encoded(PHOTO, "PNG", exif=exif(orientation))
    assert np.array_equal(decode(data), noise())


@pytest.mark.parametrize("kind", [2, 7, 12])
def test_decode_turns_a_photo_with_mistyped_tags(
    kind: int,
) -> None:
    orientation = struct.pack("<HHII", 0x0112, 3, 1, 6)
    resolution = struct.pack("<HHII", 0x011A, kind, 1, 40)  # a rational by the standard
    tags = b"Exif\0\0II*\0\x08\0\0\0\x02\0" + orientation + resolution + bytes(60)
    assert decode(encoded(PHOTO, "JPEG", exif=tags)).shape == (50, 37, 3)


def png(height: int, width: int) -> bytes:
    """A small PNG file whose header states that size."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(bytes(100))), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "empty file"),
        (b"<html>404 Not Found</html>", "not an image"),
        (bytes(1000), "not an image"),
        (FORMS["jpeg"][:400], "damaged image"),
        (FORMS["jpeg"][:-200], "damaged image"),
        (FORMS["cmyk jpeg"][:-200], "damaged image"),
        (FORMS["progressive jpeg"][:-200], "damaged image"),
        (FORMS["png"][:-200], "damaged image"),
        (FORMS["tiff"][: len(FORMS["tiff"]) // 2], "damaged image"),
        (FORMS["webp"][:-200], "damaged image"),
        (png(100_000, 100_000), "too many pixels"),
    ],
)
def test_decode_refuses_with_a_countable_reason(data: bytes, reason: str) -> None:
    with pytest.raises(DecodeError) as caught:
        decode(data)
    assert caught.value.reason == reason
    assert str(caught.value) == f"{reason}: {caught.value.found}"
    assert caught.value.found


@pytest.mark.filterwarnings("ignore")  # of Pillow, over metadata that makes no sense
@settings(max_examples=150)
@given(
    data=st.sampled_from(
        [FORMS["jpeg"], FORMS["png"], FORMS["tiff"], encoded(PHOTO, "JPEG", exif=exif(6))]
    ),
    faults=st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=4),
    cut=st.integers(0, 8000),
)
def test_decode_of_damage_raises_only_decode_errors(
    data: bytes, faults: list[tuple[int, int]], cut: int
) -> None:
    damaged = bytearray(data)
    for position, value in faults:
        damaged[position] = value
    with suppress(DecodeError):
        assert decode(bytes(damaged[: max(1, len(damaged) - cut)])).shape[2] == 3
