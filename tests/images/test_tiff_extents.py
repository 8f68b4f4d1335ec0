"""How far the pixels of a TIFF reach, read from its directories."""

import io
import struct

import numpy as np
import pytest
from PIL import Image

from pipeline.images.tiff_extents import pixels_end


def directory(entries: list[tuple[int, int, int]], after: int = 0) -> bytes:
    """Entries (tag, type, value) of one number each; the offset of the next directory."""
    packed = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in entries)
    return struct.pack("<H", len(entries)) + packed + struct.pack("<I", after)


def tiff(*directories: bytes) -> bytes:
    return b"II*\0" + struct.pack("<I", 8) + b"".join(directories)


@pytest.mark.filterwarnings("ignore:Truncated File Read")
@pytest.mark.parametrize("options", [{}, {"compression": "tiff_lzw"}, {"strip_size": 500}])
@pytest.mark.parametrize("frames", [1, 3])
def test_pixels_end_is_the_end_of_pillows_pixels(options: dict[str, object], frames: int) -> None:
    cells = np.random.default_rng(0).integers(0, 256, size=(40, 60, 3), dtype=np.uint8)
    image, stream = Image.fromarray(cells), io.BytesIO()
    image.save(stream, "TIFF", save_all=True, append_images=[image] * (frames - 1), **options)
    data = stream.getvalue()
    with Image.open(io.BytesIO(data)) as opened:
        last = 0
        for frame in range(frames):
            opened.seek(frame)
            tags = opened.tag_v2  # type: ignore[attr-defined]
            last = max([last, *map(sum, zip(tags[273], tags[279], strict=True))])
    assert pixels_end(data) == last <= len(data)
    assert pixels_end(data[: len(data) - 1]) in (last, 0), "0: the last directory is cut off"


def test_pixels_end_looks_into_sub_directories() -> None:
    """As in a DNG: the preview first, the raw image as tiles in a directory below."""
    preview = directory([(273, 4, 100), (279, 4, 50), (330, 4, 8 + 42)])
    assert len(preview) == 42
    raw = directory([(324, 4, 1000), (325, 4, 234)])
    assert pixels_end(tiff(preview, raw)) == 1234


@pytest.mark.filterwarnings("ignore:Truncated File Read")
def test_pixels_end_of_circular_or_damaged_directories() -> None:
    assert pixels_end(tiff(directory([(273, 4, 9), (279, 4, 1), (330, 4, 8)], after=8))) == 10
    assert pixels_end(tiff(directory([(330, 4, 1 << 31)], after=1 << 30))) == 0
    assert pixels_end(tiff(directory([(273, 2, 0)]))) == 0, "text where numbers belong"
    assert pixels_end(b"\0\0\0\x18ftypcrx ") == 0, "CR3 has another structure"
    assert pixels_end(b"II*\0") == 0
