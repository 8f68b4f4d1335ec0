"""The curves, scatters and maps of a paper's figures: findings in, matplotlib figures out."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.report import map_sheet
from pipeline.report.charts import SCORE_BINS, best_scores
from pipeline.report.error_map import ErrorMap
from pipeline.report.svg import CURVE_POINTS
from pipeline.report.tasks import TaskView, first_ranks
from pipeline.retrieval.metrics import recall_at

COLUMN = 3.4  # inches: one column of a paper of two
BLUE, ORANGE, GREEN, RED, GREY = "#0072b2", "#d55e00", "#16803c", "#c8322b", "#777777"
STYLES = ((BLUE, "-"), (ORANGE, "--"), (GREEN, "-."), (GREY, ":"))  # told apart without colour too

Row = Mapping[str, Any]


def recall_figure(tasks: Sequence[TaskView]) -> Figure:
    """Recall@K of every task over K."""
    figure, [axes] = _sheet(1)
    for i, task in enumerate(tasks):
        colour, dashes = STYLES[i % len(STYLES)]
        ks = sorted({round(k) for k in np.geomspace(1, task.row["gallery"], CURVE_POINTS)})
        shares = [100 * recall_at(k, first_ranks(task.rows)) for k in ks]
        axes.plot(ks, shares, color=colour, linestyle=dashes, label=task.name)
    axes.set(xscale="log", xlabel="K", ylabel="Recall@K (%)", ylim=(0, 101))
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.legend(loc="lower right")
    return figure


def scores_figure(tasks: Sequence[TaskView]) -> Figure:
    """How the scores of best true matches and best wrong answers spread."""
    figure, sheets = _sheet(len(tasks))
    for axes, task in zip(sheets, tasks, strict=True):
        both = best_scores(task.rows)
        edges = np.histogram_bin_edges(np.concatenate(both), SCORE_BINS).tolist()
        for scores, name, (colour, dashes) in zip(both, ("true", "wrong"), STYLES, strict=False):
            if scores:
                weights = np.full(len(scores), 100 / len(scores))
                axes.hist(
                    scores,
                    edges,
                    weights=weights,
                    histtype="step",
                    color=colour,
                    linestyle=dashes,
                    label=name,
                )
        axes.set(title=task.name, xlabel="cosine of the best answer", ylabel="queries (%)")
        axes.legend()
    return figure


def views_figure(rows: Sequence[Row]) -> Figure:
    """R@1 by the number of views, with 95 % intervals."""
    figure, [axes] = _sheet(1)
    views, r1, low, high = (
        np.array([row[name] for row in rows]) for name in ("views", "r1", "r1_low", "r1_high")
    )
    axes.fill_between(
        views, 100 * low, 100 * high, color=BLUE, alpha=0.18, linewidth=0, label="95 % interval"
    )
    axes.plot(views, 100 * r1, color=BLUE, marker="o", markersize=3, label="R@1")
    axes.set(xscale="log", xlabel="views a query is the mean of", ylabel="R@1 (%)")
    axes.set_xticks(views, [str(each) for each in views])
    axes.minorticks_off()
    axes.legend()
    return figure


def whiskers_figure(
    tasks: Sequence[TaskView], rows: Sequence[Row], of: str, label: Callable[[Row], str]
) -> Figure:
    """R@1 of each row with its 95 % interval, by task; dashed: the whole task. `of`: what the rows'
    labels are of.
    """
    of_task = [(task, [row for row in rows if row["task"] == task.row["task"]]) for task in tasks]
    shown = [(task, own) for task, own in of_task if len(own) > 1] or of_task[:1]
    figure, sheets = _sheet(len(shown), 0.5 + 0.17 * max(len(own) for _, own in shown))
    for axes, (task, own) in zip(sheets, shown, strict=True):
        r1, low, high = (
            100 * np.array([row[name] for row in own]) for name in ("r1", "r1_low", "r1_high")
        )
        at = np.arange(len(own))[::-1]
        axes.errorbar(
            r1, at, xerr=[r1 - low, high - r1], fmt="o", color=BLUE, markersize=3, elinewidth=1
        )
        axes.axvline(100 * task.row["r1"], color=GREY, linestyle="--", linewidth=0.8)
        axes.set_yticks(at, [label(row) for row in own])
        axes.set(title=task.name, xlabel="R@1 (%)", ylabel=of, ylim=(-0.6, len(own) - 0.4))
        axes.grid(visible=False, axis="y")
    return figure


def group_label(row: Row) -> str:
    return str(row["value"])


def gap_figure(gap: Row) -> Figure:
    """Both views on the two directions of greatest variance, some true pairs joined."""
    figure, [axes] = _sheet(1, 2.8)
    at = np.array([(point["x"], point["y"]) for point in gap["points"]])
    asked = np.array([point["side"] == "query" for point in gap["points"]])
    names = gap["task"].split("->")
    for i, j in gap["joined"]:
        axes.plot(*at[[i, j]].T, color=GREY, linewidth=0.4, zorder=1)
    axes.scatter(
        at[asked, 0],
        at[asked, 1],
        s=7,
        color=BLUE,
        marker="o",
        linewidths=0,
        alpha=0.75,
        label=names[0],
        zorder=2,
    )
    axes.scatter(
        at[~asked, 0],
        at[~asked, 1],
        s=11,
        color=ORANGE,
        marker="^",
        linewidths=0,
        label=names[1],
        zorder=3,
    )
    first, second = (100 * share for share in gap["shares"])
    axes.set(
        xlabel=f"1st component ({first:.0f} % of the variance)",
        ylabel=f"2nd ({second:.0f} %)",
        aspect="equal",
    )
    axes.legend()
    return figure


def map_figure(drawn: ErrorMap) -> Figure:
    """The page's map of errors."""
    figure, [axes] = _sheet(1, COLUMN * map_sheet.MAP_HEIGHT / map_sheet.MAP_WIDTH)
    for x1, y1, x2, y2, _ in drawn.lines:
        axes.plot([x1, x2], [y1, y2], color=RED, linewidth=0.4, alpha=drawn.opacity, zorder=1)
        axes.plot(x2, y2, "o", color=RED, markersize=1.2, zorder=1)
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


def _sheet(count: int, height: float = 2.2) -> tuple[Figure, list[Axes]]:
    """Axes side by side, one column of a paper wide each."""
    figure = Figure(figsize=(COLUMN * count, height), layout="constrained")
    return figure, list(np.atleast_1d(figure.subplots(1, count)))
