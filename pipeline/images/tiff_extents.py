"""Where the pixels of a TIFF's images lie, to find files that end before them.

LibRaw makes a picture of compressed pixels that were cut off, of whatever its memory held, and
raises no error: such a copy would be packed as noise. In: the bytes of a raw file in TIFF's
structure (DNG, NEF, CR2, ARW, PEF). Out: how far its strips and tiles reach.
"""

import io

from PIL import TiffImagePlugin

NEXT_DIRECTORIES = 330
"SubIFDs: raw files keep the full image in one and a preview in the main directory."
PIXELS = ((273, 279), (324, 325))
"Tags of the offsets and lengths of strips, and of tiles."
MAX_DIRECTORIES = 32
"Cameras write up to eight."


def pixels_end(data: bytes) -> int:
    """The offset behind the last byte of pixels that a TIFF's directories name; 0 where there is
    none, or the bytes are not in this structure.
    """
    if len(data) < 8 or data[:4] not in (b"II*\0", b"MM\0*"):
        return 0
    stream, ends = io.BytesIO(data), [0]
    header = TiffImagePlugin.ImageFileDirectory_v2(data[:8])
    waiting, seen = [header.next], set[int]()
    while waiting and len(seen) < MAX_DIRECTORIES:
        at = waiting.pop()
        if at in seen or not 0 < at < len(data):
            continue
        seen.add(at)
        stream.seek(at)
        directory = TiffImagePlugin.ImageFileDirectory_v2(data[:8])
        directory.load(stream)
        for offsets, lengths in PIXELS:
            pairs = zip(_numbers(directory, offsets), _numbers(directory, lengths), strict=False)
            ends += [offset + length for offset, length in pairs]
        waiting += [directory.next, *_numbers(directory, NEXT_DIRECTORIES)]
    return max(ends)


def _numbers(directory: TiffImagePlugin.ImageFileDirectory_v2, tag: int) -> list[int]:
    """The whole numbers of a tag; none where it has none or is damaged."""
    value = directory.get(tag, ())
    values = value if isinstance(value, tuple) else (value,)
    return [number for number in values if isinstance(number, int)]
