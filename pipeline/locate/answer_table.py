"""Answers -> the table that `locate` prints, a line per photo."""

from collections.abc import Sequence

from rich import box
from rich.table import Table

from pipeline.locate.geojson import LocatedPhoto

HEADINGS = ("photo", "position", "within", "sure", "location", "score")


def answer_table(located: Sequence[LocatedPhoto]) -> Table:
    """A row per answer: position, uncertainty, probability, location and best score."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading in HEADINGS:
        left = heading in ("photo", "location")
        table.add_column(heading, justify="left" if left else "right", overflow="fold")
    for one in located:
        table.add_row(one.name, *_cells(one))
    return table


def _cells(one: LocatedPhoto) -> list[str]:
    """The cells after the photo's name. An unknown answer shows neither position nor location."""
    answer = one.answer
    if answer is None:
        return [one.rejected[0].reason, "", "", "", ""]
    at = answer.position
    position = f"{at.lat:.6f}, {at.lon:.6f}" if at else "no position"
    return [
        position if answer.known else "unknown",
        (f"{at.radius_m:.0f} m" if at.radius_m >= 10 else f"{at.radius_m:.1f} m")
        if at and answer.known
        else "",
        "" if answer.probability is None else f"{answer.probability:.0%}",
        (answer.location or "") if answer.known else "",
        f"{answer.candidates[0].score:.3f}" if answer.candidates else "",
    ]
