"""Dense features: descriptors that stay with the ground, and photos that they place."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from jobs.encoding.dense_features import BuiltinDenseFinder
from model.dense import NUMBERS, STRIDE, DenseEncoder, load_dense, sample
from pipeline.camera.pose import PartialPose
from pipeline.core.arrays import Pixels
from pipeline.core.records import View
from pipeline.index.searcher import Hit
from pipeline.locate.locate import Answer, Position
from pipeline.locate.refined import refine_answer, refine_at
from pipeline.matching.gate import CHANCE_DENSE_INLIERS, LEAST_DENSE_INLIERS, holds
from pipeline.matching.local_features import match_features, match_mutually
from pipeline.matching.map_windows import MapWindows
from pipeline.matching.photo_features import MatchablePhoto, prepare_photo, with_dense_features
from pipeline.matching.refine import Refinement, prepare_dense_window, refine_densely
from tests.matching.made_maps import MadeMap, error_m, made_map, photo_of, window_of
from tests.matching.refinements import make_refinement

TOLD = PartialPose(heading_deg=32.0, pitch_deg=-59.0, height_m=62.0, fov_deg=55.0)


@pytest.fixture(scope="module")
def dense() -> DenseEncoder:
    return load_dense()


@pytest.fixture(scope="module")
def find() -> BuiltinDenseFinder:
    return BuiltinDenseFinder()


def on_another_day(photo_HW3: Pixels) -> MatchablePhoto:
    """Dim, blurred and of other colours: SIFT finds too few corners to hold."""
    dim_HW3 = 0.2 * photo_HW3[:, :, [1, 0, 2]].astype(np.float32) + 96
    blurred_HW3 = cv2.GaussianBlur(dim_HW3, (0, 0), 1.0)
    return prepare_photo(blurred_HW3.astype(np.uint8), TOLD)


def answer_at(made: MadeMap, number: int) -> Answer:
    """A tile of the map as the only candidate."""
    lat, lon = made.gallery.positions_N2[number].tolist()
    key = str(made.gallery.keys[number])
    hit = Hit(key=key, location=key, view=View.SATELLITE, score=0.5, lat=lat, lon=lon)
    at = Position(lat=lat, lon=lon, radius_m=20.0)
    return Answer(
        position=at, location=key, probability=None, known=True, candidates=(hit,), agreeing=1
    )


def test_descriptors_are_unit_and_cover_the_image(dense: DenseEncoder) -> None:
    described_1DHW = dense.describe(made_map(0)[:100, :130]).detach()
    assert described_1DHW.shape == (1, NUMBERS, 112 / STRIDE, 144 / STRIDE)
    assert torch.allclose(described_1DHW.norm(dim=1), torch.ones(1), atol=1e-5)


def test_descriptors_move_with_the_image(dense: DenseEncoder) -> None:
    image_HW3 = made_map(0)
    one, moved = (
        dense.describe(image_HW3[at : at + 320, at : at + 320])[0].detach() for at in (0, 32)
    )
    cosine_hw = (one[:, 12:28, 12:28] * moved[:, 8:24, 8:24]).sum(dim=0)
    assert cosine_hw.mean() > 0.99


def test_sample_at_middles_is_the_cells_own(dense: DenseEncoder) -> None:
    described_1DHW = dense.describe(made_map(0)[:64, :96]).detach()
    points_N2 = torch.tensor([[4.0, 4.0], [12.0, 4.0], [92.0, 60.0]])
    expected = [described_1DHW[0, :, row, column] for row, column in ((0, 0), (0, 1), (7, 11))]
    assert torch.allclose(sample(described_1DHW, points_N2), torch.stack(expected), atol=1e-5)


def test_finder_leaves_out_what_is_masked(find: BuiltinDenseFinder) -> None:
    mask_HW = np.zeros((64, 64), np.uint8)
    mask_HW[:, 32:] = 255
    found = find(made_map(0)[:64, :64], 8, mask_HW)
    assert found.angles_N is None
    assert found.descriptors_ND.shape == (32, NUMBERS)
    assert found.points_N2[:, 0].min() > 32


def test_refine_densely_locates_within_two_metres(find: BuiltinDenseFinder) -> None:
    window = window_of(made_map(0))
    photo = on_another_day(photo_of(window))
    found = refine_densely(photo, [prepare_dense_window(window, find)], find)
    assert found is not None
    assert found.dense
    assert holds(found)
    assert error_m(found) < 2
    other = refine_densely(photo, [prepare_dense_window(window_of(made_map(1)), find)], find)
    assert other is None or other.inliers <= CHANCE_DENSE_INLIERS


def test_refine_densely_needs_the_pose(find: BuiltinDenseFinder) -> None:
    window = window_of(made_map(0))
    photo = prepare_photo(photo_of(window), replace(TOLD, heading_deg=None))
    assert refine_densely(photo, [prepare_dense_window(window, find)], find) is None
    with pytest.raises(ValueError, match="promises no ground"):
        with_dense_features(photo, find, window.metres_per_pixel)


@pytest.mark.parametrize("matcher", [refine_answer, refine_at])
def test_dense_features_place_what_sift_does_not(
    find: BuiltinDenseFinder,
    matcher: Callable[[Answer, MatchablePhoto, MapWindows], Refinement | None],
) -> None:
    made = MadeMap()
    photo = on_another_day(photo_of(window_of(made.pixels_HW3)))
    windows, answer = made.windows(), answer_at(made, 5)
    alone = matcher(answer, photo, windows)
    assert alone is None or not holds(alone)
    windows.dense = find
    found = matcher(answer, photo, windows)
    assert found is not None
    assert found.dense
    assert error_m(found) < 2


def test_dense_refinement_needs_more_inliers() -> None:
    few = make_refinement(inliers=LEAST_DENSE_INLIERS - 1)
    assert holds(few)
    assert not holds(replace(few, dense=True))
    assert holds(make_refinement(inliers=LEAST_DENSE_INLIERS, dense=True))


def test_match_mutually_equals_the_rule_without_a_ratio() -> None:
    rng = np.random.default_rng(0)
    one_ND, other_ND = (
        rows / np.linalg.norm(rows, axis=1, keepdims=True)
        for rows in rng.standard_normal((2, 200, 16)).astype(np.float32)
    )
    pairs_M2 = match_mutually(one_ND, other_ND)
    assert 20 < len(pairs_M2) < 200
    assert np.array_equal(pairs_M2, match_features(one_ND, other_ND, 1.0))
    assert len(match_mutually(one_ND[:0], other_ND)) == 0
