"""What to expect of a region -> one self-contained HTML page.

In: expectations, outcomes of photos with their pictures, and places that resemble each other. Out:
the page as text. It has no script and loads nothing.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.core.templates import template_environment
from pipeline.images.thumbnails import ANSWER_PX, ImageLoader, thumbnail
from pipeline.region.expectation import WITHIN_M, WRONG_M, Expectation, Outcome
from pipeline.region.lookalikes import Lookalike

EXAMPLES = 4
"Photos of each kind."


@dataclass(frozen=True, kw_only=True)
class RegionPage:
    """What the page shows."""

    name: str
    "Of the map."
    flat: bool
    "Whether the ground was taken for flat."
    expectations: Sequence[Expectation]
    "With the camera's tags, without them, then by height and pitch."
    real: Expectation | None
    "Of the UAV's own photos against their GPS."
    outcomes: Sequence[Outcome]
    lookalikes: Sequence[Lookalike]
    seconds: dict[str, float]
    "Spent by stage."
    commands: Sequence[str]
    "How photos are located now."


def render_region(page: RegionPage, load_photos: ImageLoader, load_tiles: ImageLoader) -> str:
    """The page as HTML."""
    kinds = _examples(page.outcomes)
    photos = load_photos([one.name for _, group in kinds for one in group])
    tiles = load_tiles([key for pair in page.lookalikes for key in pair.keys])
    environment = template_environment(Path(__file__).parent / "templates")
    environment.filters["percent"] = _percent
    environment.filters["metres"] = _metres
    return environment.get_template("expectation.html").render(
        page=page,
        within=WITHIN_M,
        wrong_m=WRONG_M,
        rows=[*page.expectations, *([page.real] if page.real else [])],
        examples=[
            (title, [_example(one, photos.get(one.name)) for one in group])
            for title, group in kinds
            if group
        ],
        lookalikes=[
            (pair, [thumbnail(tiles.get(key), ANSWER_PX) for key in pair.keys])
            for pair in page.lookalikes
        ],
        minutes=sum(page.seconds.values()) / 60,
    )


def _examples(outcomes: Sequence[Outcome]) -> list[tuple[str, list[Outcome]]]:
    """Right answers, wrong ones, and unknown ones, some of each, spread over all."""
    right = [one for one in outcomes if one.known and one.error_m <= WITHIN_M[1]]
    wrong = [one for one in outcomes if one.known and one.error_m > WRONG_M]
    unknown = [one for one in outcomes if not one.known]
    groups = (
        (f"Found within {WITHIN_M[1]:g} m", right),
        (f"Answered, and more than {WRONG_M:g} m off", wrong),
        ("Unknown: no answer rather than a wrong one", unknown),
    )
    return [
        (title, list(group[:: max(1, len(group) // EXAMPLES)][:EXAMPLES]))
        for title, group in groups
    ]


def _example(one: Outcome, data: bytes | None) -> dict[str, Any]:
    return {
        "picture": thumbnail(data, ANSWER_PX),
        "error": _metres(one.error_m),
        "sure": "" if one.probability is None else f"{one.probability:.0%} sure",
        "how": "matched with the map" if one.refined else "by tiles",
        "way": "with tags" if one.posed else "without tags",
        "pose": f"{one.height_m:.0f} m high, pitch {one.pitch_deg:.0f}°",
    }


def _percent(value: float) -> str:
    return "–" if math.isnan(value) else f"{100 * value:.1f} %"


def _metres(value: float) -> str:
    if not math.isfinite(value):
        return "–"
    return f"{value:.2f} m" if value < 10 else f"{value:.0f} m"
