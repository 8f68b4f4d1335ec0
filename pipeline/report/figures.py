"""Figures of a paper: an evaluation in, PNG and PDF files out.

Drawn by matplotlib without its global state, from the descriptions that the page draws too. Fonts
are embedded as TrueType (type 42), which publishers require, files hold no date, and the same
evaluation gives the same bytes.
"""

import io
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from pipeline.core import storage
from pipeline.images.decode import DecodeError, decode
from pipeline.images.thumbnails import ImageLoader
from pipeline.report import figure_charts
from pipeline.report.charts import Row, scatter
from pipeline.report.inputs import EvaluationResults, ReportContext
from pipeline.report.options import FigureFormat
from pipeline.report.panels import MAX_ANSWERS, is_hit
from pipeline.report.tables import group_tables, part_tables
from pipeline.report.tasks import PanelChoice, TaskView, choose_panels, task_views

MAX_ROWS = 3  # hits, misses and places of a figure with pictures: what fits a page and a caption
DPI = 300  # of PNG, and of pictures in PDF
STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 7,
    "axes.titlesize": 7.5,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.2,
    "legend.frameon": False,
    "pdf.fonttype": 42,
    "savefig.dpi": DPI,
    "axes.grid": True,
    "grid.linewidth": 0.4,
    "grid.color": "#dddddd",
    "axes.axisbelow": True,
}
CELL = 0.78  # inches: the side of a picture
CAPTION = 0.16  # inches, below it
PAIR_GAP = 0.25  # between the two halves of a row of pairs, in pictures
PIXELS = 256  # of a picture's longer side: more than 300 dots an inch
FRAME = 2.0  # points
RIGHT_COLOUR, WRONG_COLOUR = "#16803c", "#c8322b"
NO_DATES = {"png": {"Software": None}, "pdf": {"CreationDate": None}}

Images = Mapping[str, bytes]
"Encoded images by key."


def write_figures(
    results: EvaluationResults, images: ImageLoader, folder: str, formats: tuple[FigureFormat, ...]
) -> list[str]:
    """Write every figure that the evaluation has data for into `folder`; returns their names
    without endings.

    Without images there are no figures of hits and misses.
    """
    tasks = task_views(results, ReportContext(title=""))
    figures = _chart_figures(results, tasks)
    choices = choose_panels(tasks, MAX_ROWS)
    pictures = images(sorted(set[str]().union(*(choice.keys for choice in choices))))
    for choice in choices if pictures else ():
        name = choice.task.anchor
        figures[f"retrieval-{name}"] = partial(panels_figure, choice, pictures)
        if choice.pairs.shown:
            figures[f"multi-query-{name}"] = partial(pairs_figure, choice, pictures)
    for name, draw in figures.items():
        for kind in formats:
            with matplotlib.rc_context(STYLE):
                # Drawn again for each format: drawing moves what the layout has placed.
                data = _encode(draw(), kind)
            storage.write_bytes(storage.join(folder, f"{name}.{kind}"), data)
    return list(figures)


def _chart_figures(
    results: EvaluationResults, tasks: Sequence[TaskView]
) -> dict[str, Callable[[], Figure]]:
    """What draws each figure without pictures, by its name."""
    single = [task for task in tasks if not task.merged]
    names = {task.row["task"]: task.name for task in single}
    r1 = {task.row["task"]: task.row["r1"] for task in single}
    figures = {"recall": partial(figure_charts.recall_figure, [task.recall for task in tasks])}
    if scores := [task.scores for task in single if task.scores]:
        figures["scores"] = partial(figure_charts.charts_figure, scores)
    if views := [task.views for task in single if task.views]:
        figures["views"] = partial(figure_charts.charts_figure, views)
    if parts := part_tables(results.parts, names, r1):
        figures["parts"] = partial(figure_charts.whiskers_figure, parts)
    groups = group_tables(results.groups, names, r1)
    for column in dict.fromkeys(table.column for table in groups):
        own = [table for table in groups if table.column == column]
        figures[f"groups-{column}"] = partial(figure_charts.whiskers_figure, own)
    for gap in results.gaps:
        name = f"view-gap-{gap['task'].replace('->', '-')}"
        figures[name] = partial(figure_charts.scatter_figure, scatter(gap))
    for task in single:
        if task.errors:
            figures[f"map-{task.anchor}"] = partial(figure_charts.map_figure, task.errors)
    return dict(figures)


def _encode(figure: Figure, kind: FigureFormat) -> bytes:
    stream = io.BytesIO()
    figure.savefig(
        stream, format=kind, bbox_inches="tight", pad_inches=0.03, metadata=NO_DATES[kind]
    )
    return stream.getvalue()


def panels_figure(choice: PanelChoice, images: Images) -> Figure:
    """One query per row with its best answers, framed green if right and red if wrong: hits, then
    misses.
    """
    rows = [*choice.hits, *choice.misses]
    figure, cells = _grid(max(len(rows), 1), 1 + MAX_ANSWERS)
    for line, row in zip(cells, rows, strict=False):
        _picture(line[0], _image(images.get(row["query"])), "hit" if is_hit(row) else "miss")
        _answers(line[1:], row, images)
    return figure


def pairs_figure(choice: PanelChoice, images: Images) -> Figure:
    """One place per row: on the left one image and its best answers, on the right all images merged
    and theirs.
    """
    pairs = choice.pairs.shown
    half = 1 + MAX_ANSWERS
    figure, cells = _grid(len(pairs), 2 * half + 1, [1.0] * half + [PAIR_GAP] + [1.0] * half)
    for line, pair in zip(cells, pairs, strict=True):
        _picture(line[0], _image(images.get(pair.single["query"])), "one image")
        _answers(line[1:half], pair.single, images)
        _picture(line[half + 1], _mosaic([images.get(key) for key in pair.images]), "all images")
        _answers(line[half + 2 :], pair.merged, images)
    return figure


def _answers(cells: Sequence[Axes], row: Row, images: Images) -> None:
    best = zip(row["top_keys"], row["top_locations"], row["top_scores"], strict=True)
    for cell, (key, location, score) in zip(cells, best, strict=False):
        _picture(
            cell,
            _image(images.get(key)),
            f"{score:.3f}",
            RIGHT_COLOUR if location == row["location"] else WRONG_COLOUR,
        )


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
    """The central square of an encoded image; None if it cannot be decoded."""
    if data is None:
        return None
    try:
        full = Image.fromarray(decode(data))
    except DecodeError:
        return None
    side = min(full.size)
    left, top = (full.width - side) // 2, (full.height - side) // 2
    square = full.crop((left, top, left + side, top + side))
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


def _grid(rows: int, columns: int, widths: Sequence[float] | None = None) -> tuple[Figure, Any]:
    """A grid of invisible cells for pictures. `widths`: of the columns, in pictures."""
    figure = Figure(figsize=(CELL * sum(widths or [columns]), (CELL + CAPTION) * rows))
    cells = figure.subplots(rows, columns, squeeze=False, width_ratios=widths)
    figure.subplots_adjust(0, 0, 1, 1, wspace=0.1, hspace=0.1 + CAPTION / CELL)
    for cell in cells.flat:
        cell.set_visible(False)
    return figure, cells
