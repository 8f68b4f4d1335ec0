"""Hits and misses, and one image beside all of its place, as a paper shows them: chosen queries in, figures out."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from pipeline.report_choice import Choice
from pipeline.report_panels import ANSWERS, is_hit
from pipeline.transforms import DecodeError, decode

CELL = 0.78  # inches of a picture
CAPTION = 0.16  # below it
GAP = 0.25  # between the halves of a line of pairs, in pictures
PIXELS = 256  # of a picture's longer side: more than 300 dots an inch
FRAME = 2.0  # points

Row = Mapping[str, Any]
Images = Mapping[str, bytes]
RIGHT, WRONG = "#16803c", "#c8322b"


def panels_figure(choice: Choice, images: Images) -> Figure:
    """A query a row with its best answers, framed green where right and red where wrong: hits, then misses."""
    rows = [*choice.hits, *choice.misses]
    figure, cells = _sheet(max(len(rows), 1), 1 + ANSWERS)
    for line, row in zip(cells, rows, strict=False):
        _picture(line[0], _image(images.get(row["query"])), "hit" if is_hit(row) else "miss")
        _answers(line[1:], row, images)
    return figure


def pairs_figure(choice: Choice, images: Images) -> Figure:
    """A place a row: one image and its best answers on the left, all images and theirs on the right."""
    pairs = choice.pairs.shown
    half = 1 + ANSWERS
    figure, cells = _sheet(len(pairs), 2 * half + 1, [1.0] * half + [GAP] + [1.0] * half)
    for line, pair in zip(cells, pairs, strict=True):
        _picture(line[0], _image(images.get(pair.single["query"])), "one image")
        _answers(line[1:half], pair.single, images)
        _picture(line[half + 1], _mosaic([images.get(key) for key in pair.images]), "all images")
        _answers(line[half + 2 :], pair.merged, images)
    return figure


def _answers(cells: Sequence[Axes], row: Row, images: Images) -> None:
    best = zip(row["top_keys"], row["top_locations"], row["top_scores"], strict=True)
    for cell, (key, location, score) in zip(cells, best, strict=False):
        _picture(cell, _image(images.get(key)), f"{score:.3f}", RIGHT if location == row["location"] else WRONG)


def _picture(cell: Axes, image: Image.Image | None, caption: str, frame: str | None = None) -> None:
    cell.set_visible(True)
    if image is not None:
        cell.imshow(np.asarray(image), interpolation="antialiased", aspect="equal")
    cell.set(xticks=[], yticks=[])
    cell.grid(visible=False)
    for spine in cell.spines.values():
        spine.set(visible=frame is not None, edgecolor=frame or "none", linewidth=FRAME)
    cell.set_xlabel(caption, fontsize=6, labelpad=2)


def _image(data: bytes | None) -> Image.Image | None:
    """A square cut from the middle; None without a picture that can be read."""
    if data is None:
        return None
    try:
        whole = Image.fromarray(decode(data))
    except DecodeError:
        return None
    side = min(whole.size)
    left, top = (whole.width - side) // 2, (whole.height - side) // 2
    square = whole.crop((left, top, left + side, top + side))
    square.thumbnail((PIXELS, PIXELS), Image.Resampling.LANCZOS)
    return square


def _mosaic(found: Sequence[bytes | None]) -> Image.Image:
    """Up to nine pictures, three a row."""
    step = PIXELS // 3
    sheet = Image.new("RGB", (3 * step, 3 * step), "white")
    for i, data in enumerate(found):
        if (image := _image(data)) is not None:
            sheet.paste(image.resize((step - 2, step - 2)), (i % 3 * step + 1, i // 3 * step + 1))
    return sheet


def _sheet(rows: int, columns: int, widths: Sequence[float] | None = None) -> tuple[Figure, Any]:
    """Cells for pictures, all empty and unseen. `widths`: of the columns, in pictures."""
    figure = Figure(figsize=(CELL * sum(widths or [columns]), (CELL + CAPTION) * rows))
    cells = figure.subplots(rows, columns, squeeze=False, width_ratios=widths)
    figure.subplots_adjust(0, 0, 1, 1, wspace=0.1, hspace=0.1 + CAPTION / CELL)
    for cell in cells.flat:
        cell.set_visible(False)
    return figure, cells
