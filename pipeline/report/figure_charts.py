"""Charts of a paper: descriptions of `charts`, `tables` and `error_map` in, matplotlib figures
out."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.report import map_sheet
from pipeline.report.charts import Axis, Chart, Point, Scatter, Series
from pipeline.report.error_map import ErrorMap
from pipeline.report.tables import WhiskerTable

COLUMN = 3.4  # inches: one column of a two-column paper
BLUE, ORANGE, GREEN, RED, GREY = "#0072b2", "#d55e00", "#16803c", "#c8322b", "#777777"
STYLES = ((BLUE, "-"), (ORANGE, "--"), (GREEN, "-."), (GREY, ":"))  # distinct without colour too
ROLE_STYLES = {"main": STYLES[0], "beside": STYLES[1]}


def recall_figure(charts: Sequence[Chart]) -> Figure:
    """The recall curves of all tasks in one set of axes."""
    figure, [axes] = _figure(1)
    for i, chart in enumerate(charts):
        [series] = [each for each in chart.series if each.role == "main"]
        _draw_curve(axes, series, STYLES[i % len(STYLES)], chart.title)
    _label_axis(axes, "x", charts[0].x)
    _label_axis(axes, "y", charts[0].y)
    axes.set(ylim=(0, 1.01))
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.legend(loc="lower right")
    return figure


def charts_figure(charts: Sequence[Chart]) -> Figure:
    """Charts side by side, each with its series, intervals and legend."""
    figure, sheets = _figure(len(charts))
    for axes, chart in zip(sheets, charts, strict=True):
        for series in sorted(chart.series, key=lambda each: each.role, reverse=True):
            _draw_curve(axes, series, ROLE_STYLES[series.role], series.name)
        _label_axis(axes, "x", chart.x)
        _label_axis(axes, "y", chart.y)
        if chart.x.log:
            axes.set_xticks([tick.at for tick in chart.x.ticks], [t.label for t in chart.x.ticks])
            axes.minorticks_off()
        axes.set(title=chart.title)
        axes.legend()
    return figure


def whiskers_figure(tables: Sequence[WhiskerTable]) -> Figure:
    """R@1 of each row with its 95 % interval, a table in each set of axes; dashed: the whole
    task."""
    figure, sheets = _figure(len(tables), 0.5 + 0.17 * max(len(table.rows) for table in tables))
    for axes, table in zip(sheets, tables, strict=True):
        r1, low, high = (
            100 * np.array(column)
            for column in zip(*((row.r1, row.low, row.high) for row in table.rows), strict=True)
        )
        at = np.arange(len(r1))[::-1]
        axes.errorbar(
            r1, at, xerr=[r1 - low, high - r1], fmt="o", color=BLUE, markersize=3, elinewidth=1
        )
        axes.axvline(100 * table.overall, color=GREY, linestyle="--", linewidth=0.8)
        axes.set_yticks(at, [row.label for row in table.rows])
        axes.set(title=table.title, xlabel="R@1 (%)", ylabel=table.heading)
        axes.set(ylim=(-0.6, len(r1) - 0.4))
        axes.grid(visible=False, axis="y")
    return figure


def scatter_figure(scatter: Scatter) -> Figure:
    """Both views on the two directions of greatest variance, with some true pairs joined."""
    figure, [axes] = _figure(1, 2.8)
    for pair in scatter.pairs:
        axes.plot(*zip(*pair, strict=True), color=GREY, linewidth=0.4, zorder=1)
    _draw_points(axes, scatter.query_points, scatter.query_view, BLUE, "o", 7, 2)
    _draw_points(axes, scatter.gallery_points, scatter.gallery_view, ORANGE, "^", 11, 3)
    first, second = (100 * share for share in scatter.shares)
    axes.set(
        xlabel=f"1st component ({first:.0f} % of the variance)",
        ylabel=f"2nd ({second:.0f} %)",
        aspect="equal",
    )
    axes.legend()
    return figure


def map_figure(drawn: ErrorMap) -> Figure:
    """The page's map of errors."""
    figure, [axes] = _figure(1, COLUMN * map_sheet.MAP_HEIGHT / map_sheet.MAP_WIDTH)
    for arrow in drawn.arrows:
        axes.annotate(
            "",
            xy=(arrow.x2, arrow.y2),
            xytext=(arrow.x1, arrow.y1),
            arrowprops={
                "arrowstyle": "-|>,head_length=.12,head_width=.06",
                "color": BLUE if arrow.right else RED,
                "linewidth": 0.4,
                "alpha": drawn.opacity,
                "shrinkA": 0,
                "shrinkB": 0,
            },
            zorder=1,
        )
    for found, name, look in (
        (True, "found first by half or more", {"color": GREEN}),
        (
            False,
            "by fewer",
            {"markerfacecolor": "white", "markeredgecolor": RED, "markeredgewidth": 0.8},
        ),
    ):
        places = [place for place in drawn.places if place.found == found]
        axes.plot(
            [p.x for p in places], [p.y for p in places], "o", markersize=3, label=name, **look
        )
    length, text = drawn.bar
    left, bottom = map_sheet.MAP_MARGIN, map_sheet.MAP_HEIGHT - 6
    axes.plot([left, left + length], [bottom, bottom], color="black", linewidth=1)
    axes.text(left + length + 6, bottom, text, va="center")
    axes.annotate(
        "N",
        (map_sheet.MAP_WIDTH - 16, map_sheet.MAP_HEIGHT - 30),
        (map_sheet.MAP_WIDTH - 16, map_sheet.MAP_HEIGHT - 4),
        ha="center",
        va="center",
        arrowprops={"arrowstyle": "->", "linewidth": 0.8},
    )
    axes.set(
        xlim=(0, map_sheet.MAP_WIDTH),
        ylim=(map_sheet.MAP_HEIGHT, 0),
        aspect="equal",
        title=drawn.title,
    )
    axes.set_axis_off()
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 0), ncols=2)
    return figure


def _figure(count: int, height: float = 2.2) -> tuple[Figure, list[Axes]]:
    """Axes side by side, each one paper column wide."""
    figure = Figure(figsize=(COLUMN * count, height), layout="constrained")
    return figure, list(np.atleast_1d(figure.subplots(1, count)))


def _draw_curve(axes: Axes, series: Series, style: tuple[str, str], label: str) -> None:
    colour, dashes = style
    x, y = zip(*series.points, strict=True)
    if series.interval:
        at, low, high = zip(*series.interval, strict=True)
        axes.fill_between(
            at, low, high, color=colour, alpha=0.18, linewidth=0, label="95 % interval"
        )
    if series.bin_edges:
        axes.stairs(y, series.bin_edges, color=colour, linestyle=dashes, label=label)
    else:
        marker = "o" if len(series.dots) == len(series.points) else None
        axes.plot(x, y, color=colour, linestyle=dashes, marker=marker, markersize=3, label=label)


def _label_axis(axes: Axes, which: str, axis: Axis) -> None:
    target = axes.xaxis if which == "x" else axes.yaxis
    target.set_label_text(axis.label + (" (%)" if axis.percent else ""))
    if axis.log:
        axes.set(**{f"{which}scale": "log"})
    if axis.percent:
        target.set_major_formatter(lambda value, _: f"{100 * value:g}")


def _draw_points(
    axes: Axes, points: Sequence[Point], label: str, colour: str, marker: str, area: int, layer: int
) -> None:
    x, y = zip(*points, strict=True)
    axes.scatter(
        x,
        y,
        s=area,
        color=colour,
        marker=marker,
        linewidths=0,
        alpha=0.75,
        label=label,
        zorder=layer,
    )
