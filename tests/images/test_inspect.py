"""Inspection against decoding: the same size for complete images of every kind, and a countable
reason for the others.
"""

import io
import struct
import zlib
from contextlib import suppress

import numpy as np
import pytest
import simplejpeg
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageCms, ImageFile

from pipeline.images.decode import DecodeError, decode
from pipeline.images.inspect import MAX_PIXELS, inspect

PHOTO = Image.fromarray(np.random.default_rng(0).integers(0, 256, (37, 50, 3), dtype=np.uint8))
DEEP = Image.fromarray(np.random.default_rng(0).integers(0, 65536, (37, 50), dtype=np.uint16))
ICC = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
XMP = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description tiff:Orientation="6"/></x:xmpmeta>'


def exif(orientation: int) -> Image.Exif:
    tags = Image.Exif()
    tags[0x0112], tags[0x010F] = orientation, "a camera"
    return tags


def encoded(form: str, image: Image.Image = PHOTO, **options: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, form, **options)
    return buffer.getvalue()


def with_thumbnail() -> bytes:
    """A photo whose EXIF segment holds a small JPEG, end marker included."""
    small = encoded("JPEG", PHOTO.resize((16, 16)))
    tags = (
        b"Exif\0\0II*\0\x08\0\0\0\x01\0" + struct.pack("<HHII", 0x0112, 3, 1, 6) + bytes(4) + small
    )
    return encoded("JPEG", exif=tags)


PLAIN = encoded("JPEG")
JPEGS = {
    "jpeg": PLAIN,
    "progressive jpeg": encoded("JPEG", progressive=True),
    "grey jpeg": encoded("JPEG", PHOTO.convert("L")),
    "cmyk jpeg": encoded("JPEG", PHOTO.convert("CMYK")),
    "jpeg with restarts": encoded("JPEG", restart_marker_blocks=1),
    "jpeg with all segments": encoded(
        "JPEG", exif=exif(8), xmp=XMP, icc_profile=ICC, comment=b"\xff\xd9"
    ),
    "jpeg turned by XMP": encoded("JPEG", xmp=XMP),
    "jpeg with a thumbnail": with_thumbnail(),
    "two jpegs in one": encoded("MPO", save_all=True, append_images=[PHOTO.resize((25, 18))]),
    "jpeg with a trailer": PLAIN + b"SEFT" + bytes(5000),
    "jpeg with filling": PLAIN[:2] + b"\xff\xff\xff" + PLAIN[2:],
}
PNGS = {
    "png": encoded("PNG"),
    "rgba png": encoded("PNG", PHOTO.convert("RGBA")),
    "grey png with alpha": encoded("PNG", PHOTO.convert("LA")),
    "palette png": encoded("PNG", PHOTO.convert("P")),
    "black and white png": encoded("PNG", PHOTO.convert("1")),
    "deep png": encoded("PNG", DEEP),
    "turned png": encoded("PNG", exif=exif(5)),
}
WEBPS = {
    "webp": encoded("WEBP"),
    "lossless webp": encoded("WEBP", lossless=True),
    "turned webp": encoded("WEBP", exif=exif(6)),
}
OTHERS = {
    "tiff": encoded("TIFF", compression="tiff_lzw"),
    "turned tiff": encoded("TIFF", exif=exif(6)),
    "deep tiff": encoded("TIFF", DEEP),
    "bmp": encoded("BMP"),
    "gif": encoded("GIF", PHOTO.convert("P")),
}
COMPLETE = (
    JPEGS
    | PNGS
    | WEBPS
    | OTHERS
    | {f"jpeg held {n}": encoded("JPEG", exif=exif(n)) for n in range(10)}
)


@pytest.mark.parametrize("data", COMPLETE.values(), ids=COMPLETE)
def test_inspect_gives_the_size_that_decoding_gives(data: bytes) -> None:
    height, width, _ = decode(data).shape
    assert inspect(data) == (width, height)
    assert sorted(inspect(data)) == [37, 50]


@pytest.mark.parametrize(
    "data", [*JPEGS.values(), *PNGS.values(), *WEBPS.values()], ids=[*JPEGS, *PNGS, *WEBPS]
)
def test_inspect_refuses_half_an_image(data: bytes) -> None:
    complete = data[: data.rindex(b"SEFT")] if b"SEFT" in data else data
    with pytest.raises(DecodeError) as caught:
        inspect(complete[: len(complete) // 3])  # of two JPEGs in one file the first, too, is cut
    assert caught.value.reason in ("truncated image", "damaged image")


@settings(max_examples=300)
@given(data=st.sampled_from(list(COMPLETE.values())), share=st.floats(0, 1, exclude_max=True))
def test_truncation_is_found_by_inspect_or_decode(data: bytes, share: float) -> None:
    cut = data[: int(share * len(data))]
    with suppress(DecodeError):
        size = inspect(cut)
        height, width, _ = decode(cut).shape
        assert size == (width, height)
        # A trailer, a second image, or last bytes that a format does not need may be cut off.
        # that do not need them.
        assert np.array_equal(decode(cut), decode(data))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Pillow, over metadata that makes no sense
@settings(max_examples=300)
@given(
    data=st.sampled_from(list(COMPLETE.values())),
    faults=st.lists(st.tuples(st.integers(0, 700), st.integers(0, 255)), max_size=4),
)
def test_inspect_of_damage_raises_only_decode_errors(
    data: bytes, faults: list[tuple[int, int]]
) -> None:
    damaged = bytearray(data)
    for position, value in faults:
        damaged[position % len(damaged)] = value
    with suppress(DecodeError):
        assert all(side > 0 for side in inspect(bytes(damaged)))


def png(width: int, height: int) -> bytes:
    """A small PNG file whose header states that size."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(bytes(100))), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )


def jpeg_of(width: int, height: int) -> bytes:
    """A JPEG file whose header states that size."""
    frame = PLAIN.index(b"\xff\xc0") + 5
    return PLAIN[:frame] + struct.pack(">HH", height, width) + PLAIN[frame + 4 :]


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "empty file"),
        (b"<html>404 Not Found</html>", "not an image"),
        (bytes(1000), "not an image"),
        (PLAIN[:-2], "truncated image"),
        (PLAIN[:100], "truncated image"),
        (PLAIN[: len(PLAIN) // 2] + bytes(len(PLAIN) // 2), "truncated image"),
        (with_thumbnail()[:-300], "truncated image"),
        (b"\xff\xd8\xff\xd9", "truncated image"),
        (
            PLAIN.replace(b"\xff\xc0", b"\xff\xc5"),
            "damaged image",
        ),  # of a kind that libjpeg does not know
        (PLAIN[:20] + PLAIN[PLAIN.index(b"\xff\xda") :], "damaged image"),
        (PNGS["png"][:-4], "truncated image"),
        (PNGS["png"][:8] + PNGS["png"][33:], "damaged image"),
        (PNGS["png"][:33] + PNGS["png"][-12:], "damaged image"),
        (WEBPS["webp"][:-1], "truncated image"),
        (OTHERS["tiff"][: len(OTHERS["tiff"]) // 2], "damaged image"),
        (png(100_000, 100_000), "too many pixels"),
        (jpeg_of(60_000, 60_000), "too many pixels"),
        (jpeg_of(1, 60_000), "absurd dimensions"),
        (jpeg_of(0, 50), "absurd dimensions"),
        (png(1, 1), "absurd dimensions"),
        (png(8, 801), "absurd dimensions"),
        (png(70_000, 900), "absurd dimensions"),
        (encoded("BMP", PHOTO.resize((7, 7))), "absurd dimensions"),
    ],
)
def test_inspect_refuses_with_a_countable_reason(data: bytes, reason: str) -> None:
    with pytest.raises(DecodeError) as caught:
        inspect(data)
    assert caught.value.reason == reason
    assert caught.value.found


def test_max_pixels_are_those_of_pillow() -> None:
    assert Image.MAX_IMAGE_PIXELS is not None
    assert 2 * Image.MAX_IMAGE_PIXELS == MAX_PIXELS


def test_inspect_of_a_jpeg_does_not_decode(monkeypatch: pytest.MonkeyPatch) -> None:
    data = encoded("JPEG", quality=90)
    monkeypatch.setattr(ImageFile.ImageFile, "load", lambda image: pytest.fail("decoded"))
    monkeypatch.setattr(simplejpeg, "decode_jpeg", lambda *_, **__: pytest.fail("decoded"))
    inspect(data)
