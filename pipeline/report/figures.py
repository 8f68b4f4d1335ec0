"""Figures for a paper: an evaluation in, PNG and PDF files out.

Drawn by matplotlib without its global state. Fonts are embedded as TrueType (type 42), which
publishers ask for, files hold no date, and the same evaluation gives the same bytes.
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
from pipeline.report.error_map import error_map
from pipeline.report.inputs import EvaluationResults, ReportContext
from pipeline.report.options import FigureFormat
from pipeline.report.panels import MAX_ANSWERS, is_hit
from pipeline.report.tasks import PanelChoice, choose_panels, task_view
from pipeline.retrieval.parts import part_label

ROWS = 3  # hits, misses and places of a figure with pictures: what fits a page beside its caption
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
NO_DATES = {"png": {"Software": None}, "pdf": {"CreationDate": None}}


def write_figures(
    findings: EvaluationResults,
    pictures: ImageLoader,
    folder: str,
    formats: tuple[FigureFormat, ...],
) -> list[str]:
    """Write every figure that the evaluation has data for into `folder`; returns their names
    without endings.

    Without pictures at hand there are no figures of hits and misses.
    """
    tasks = [
        task_view(row, findings.results_of(row), ReportContext(title=""))
        for row in findings.metrics
    ]
    single = [task for task in tasks if not task.row["multi_query"]]
    makers: dict[str, Callable[[], Figure]] = {
        "recall": partial(figure_charts.recall_figure, tasks)
    }
    if single:
        makers["scores"] = partial(figure_charts.scores_figure, single)
    if findings.views:
        makers["views"] = partial(figure_charts.views_figure, findings.views)
    if findings.parts:
        makers["parts"] = partial(
            figure_charts.whiskers_figure, single, findings.parts, "part", part_label
        )
    for column in dict.fromkeys(row["by"] for row in findings.groups):
        rows = [row for row in findings.groups if row["by"] == column]
        makers[f"groups-{column}"] = partial(
            figure_charts.whiskers_figure,
            single,
            rows,
            column.replace("_", " "),
            figure_charts.group_label,
        )
    for gap in findings.gaps:
        makers[f"view-gap-{gap['task'].replace('->', '-')}"] = partial(
            figure_charts.gap_figure, gap
        )
    for task in single:
        if drawn := error_map(task.name, task.rows):
            makers[f"map-{task.anchor}"] = partial(figure_charts.map_figure, drawn)
    choices = choose_panels(tasks, ROWS)
    images = pictures(sorted(set[str]().union(*(choice.keys for choice in choices))))
    for choice in choices if images else ():
        name = choice.task.anchor
        makers[f"retrieval-{name}"] = partial(panels_figure, choice, images)
        if choice.pairs.shown:
            makers[f"multi-query-{name}"] = partial(pairs_figure, choice, images)
    for name, make in makers.items():
        for kind in formats:
            with matplotlib.rc_context(
                STYLE
            ):  # drawn anew for each format: drawing moves what the layout has placed
                storage.write_bytes(storage.join(folder, f"{name}.{kind}"), _saved(make(), kind))
    return list(makers)


def _saved(figure: Figure, kind: FigureFormat) -> bytes:
    stream = io.BytesIO()
    figure.savefig(
        stream, format=kind, bbox_inches="tight", pad_inches=0.03, metadata=NO_DATES[kind]
    )
    return stream.getvalue()


CELL = 0.78  # inches of a picture
CAPTION = 0.16  # below it
GAP = 0.25  # between the halves of a line of pairs, in pictures
PIXELS = 256  # of a picture's longer side: more than 300 dots an inch
FRAME = 2.0  # points

Row = Mapping[str, Any]
Images = Mapping[str, bytes]
RIGHT, WRONG = "#16803c", "#c8322b"


def panels_figure(choice: PanelChoice, images: Images) -> Figure:
    """A query a row with its best answers, framed green where right and red where wrong: hits, then
    misses.
    """
    rows = [*choice.hits, *choice.misses]
    figure, cells = _sheet(max(len(rows), 1), 1 + MAX_ANSWERS)
    for line, row in zip(cells, rows, strict=False):
        _picture(line[0], _image(images.get(row["query"])), "hit" if is_hit(row) else "miss")
        _answers(line[1:], row, images)
    return figure


def pairs_figure(choice: PanelChoice, images: Images) -> Figure:
    """A place a row: one image and its best answers on the left, all images and theirs on the
    right.
    """
    pairs = choice.pairs.shown
    half = 1 + MAX_ANSWERS
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
        _picture(
            cell,
            _image(images.get(key)),
            f"{score:.3f}",
            RIGHT if location == row["location"] else WRONG,
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
