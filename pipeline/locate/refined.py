"""Answers of retrieval, and the map's pixels -> answers within metres.

In: an answer with its candidates, a photo's pixels, and what is known of its camera. Out: the
answer at the place that matching finds, where that holds; else as it was.
"""

from collections.abc import Iterator
from dataclasses import replace

from pipeline.camera.pose import PartialPose
from pipeline.core.arrays import Pixels
from pipeline.locate.locate import Answer, Position
from pipeline.matching.gate import holds
from pipeline.matching.map_windows import MapWindows
from pipeline.matching.refine import MatchablePhoto, Refinement, prepare_photo, refine

MOST_WINDOWS = 3
"Windows that a photo is matched with: around the answer, then around other candidates."


def refine_answer(
    answer: Answer, photo_HW3: Pixels, pose: PartialPose, windows: MapWindows
) -> Refinement | None:
    """The photo matched with the map around an answer and around its other candidates; None where
    no view holds that a camera can have."""
    return refine_prepared(answer, prepare_photo(photo_HW3, pose), windows)


def refine_prepared(
    answer: Answer, photo: MatchablePhoto, windows: MapWindows
) -> Refinement | None:
    """As `refine_answer`, of a photo whose features were found before."""
    near = windows.around(_positions(answer), MOST_WINDOWS, photo.reach_m)
    return refine(photo, near)


def _positions(answer: Answer) -> Iterator[tuple[float, float, str]]:
    """The answer's position, then its candidates', each with the key of the tile that tells the
    window's size."""
    if answer.position is not None:
        yield answer.position.lat, answer.position.lon, answer.candidates[0].key
    for hit in answer.candidates:
        if hit.lat is not None and hit.lon is not None:
            yield hit.lat, hit.lon, hit.key


def with_refinement(answer: Answer, refinement: Refinement | None) -> Answer:
    """The answer at the refined place, if the refinement holds. Its probability is then unknown: a
    calibration knows that of the tile only."""
    if refinement is None or not holds(refinement):
        return answer
    position = Position(
        lat=refinement.lat,
        lon=refinement.lon,
        radius_m=refinement.ellipse.major_m,
        how="refined",
        ellipse=refinement.ellipse,
    )
    return replace(answer, position=position, probability=None, known=True, refinement=refinement)
