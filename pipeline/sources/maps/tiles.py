"""Planning the tiles of a mosaic. In: sizes in pixels. Out: windows that cover it. Nothing is read
here.

Windows of one size lie on a regular grid. The last of a row or column is moved back so that it ends
at the border: no pixel is lost and no tile is padded. Along a side shorter than a tile there is one
tile, as long as that side.
"""

import re
from dataclasses import dataclass

WINDOW_PATTERN = re.compile(r"x(\d+)-y(\d+)-w(\d+)-h(\d+)")


@dataclass(frozen=True, kw_only=True)
class Window:
    """A rectangle of a mosaic's pixels."""

    x: int
    "Column of the left edge, pixels."
    y: int
    "Row of the upper edge, pixels."
    width: int
    "Pixels."
    height: int
    "Pixels."

    @property
    def part(self) -> str:
        """The window in words: `x0000512-y0000256-w512-h512`; they sort as the windows lie."""
        return f"x{self.x:07d}-y{self.y:07d}-w{self.width}-h{self.height}"

    @property
    def corners(self) -> tuple[tuple[int, int], ...]:
        """(x, y) of the four corners in pixels, from the upper left clockwise."""
        right, bottom = self.x + self.width, self.y + self.height
        return ((self.x, self.y), (right, self.y), (right, bottom), (self.x, bottom))

    @property
    def centre(self) -> tuple[float, float]:
        """(x, y) in pixels; (0.5, 0.5) is the middle of a mosaic's first pixel."""
        return self.x + self.width / 2, self.y + self.height / 2


@dataclass(frozen=True, kw_only=True)
class Tile:
    """A window's place in the grid."""

    row: int
    column: int
    window: Window


def plan_tiles(size: tuple[int, int], tile: tuple[int, int], overlap: float) -> list[Tile]:
    """Tiles over a mosaic, row by row; all (width, height) in pixels.

    Neighbours share the fraction `overlap` of a tile, to the nearest pixel; the last of a row or
    column may share more.
    """
    width, height = min(tile[0], size[0]), min(tile[1], size[1])
    columns, rows = (
        tile_starts(length, side, overlap) for length, side in zip(size, tile, strict=True)
    )
    return [
        Tile(row=row, column=column, window=Window(x=x, y=y, width=width, height=height))
        for row, y in enumerate(rows)
        for column, x in enumerate(columns)
    ]


def plan_levels(
    size: tuple[int, int], levels: dict[str, tuple[int, int]], overlap: float
) -> dict[str, list[Tile]]:
    """`plan_tiles` for each of several tile sizes, by name. A window is in one level only: that of
    an entire mosaic, which is smaller than the tiles of several, in the first.
    """
    planned: dict[str, list[Tile]] = {}
    before: set[Window] = set()
    for name, tile in levels.items():
        new = [one for one in plan_tiles(size, tile, overlap) if one.window not in before]
        before.update(one.window for one in new)
        if new:
            planned[name] = new
    return planned


def count_tiles(size: tuple[int, int], tile: tuple[int, int], overlap: float) -> int:
    """How many `plan_tiles` gives, known at once whatever the sizes are."""
    columns, rows = (
        1 + len(_starts_before_last(length, side, overlap))
        for length, side in zip(size, tile, strict=True)
    )
    return columns * rows


def tile_starts(length: int, side: int, overlap: float) -> list[int]:
    """Where tiles of `side` pixels begin along `length` pixels: ascending, and the last one ends at
    the border.
    """
    return [*_starts_before_last(length, side, overlap), max(0, length - side)]


def _starts_before_last(length: int, side: int, overlap: float) -> range:
    return range(0, length - side, max(1, round(side * (1 - overlap))))


def parse_window(part: str) -> Window:
    """The window that `part` says.

    Raises ValueError where it says none.
    """
    said = WINDOW_PATTERN.fullmatch(part)
    if said is None:
        raise ValueError(f"{part!r} is no window; expected x<left>-y<upper>-w<width>-h<height>")
    x, y, width, height = map(int, said.groups())
    return Window(x=x, y=y, width=width, height=height)
