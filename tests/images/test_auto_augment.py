"""AutoAugment's table: its rows, its magnitudes, and its operations on small images."""

from collections import Counter

import numpy as np
import pytest
from PIL import Image

from pipeline.core.arrays import Pixels
from pipeline.images.auto_augment import (
    IMAGENET_POLICY,
    OPERATIONS,
    Operation,
    auto_augment,
    magnitude,
)

RAMP: Pixels = np.arange(256, dtype=np.uint8).reshape(16, 16)[..., None].repeat(3, 2)
"Each byte once, as a grey."


def applied(operation: Operation, index: int = 0, sign: int = 1, image: Pixels = RAMP) -> Pixels:
    return np.asarray(OPERATIONS[operation](Image.fromarray(image), index, sign))


def test_policy_has_25_rows_of_known_operations() -> None:
    assert len(IMAGENET_POLICY) == 25
    assert len(set(IMAGENET_POLICY)) == 20
    steps = [step for row in IMAGENET_POLICY for step in row]
    assert {operation for operation, _, _ in steps} == set(OPERATIONS)
    assert all(0 <= probability <= 1 and 0 <= index <= 9 for _, probability, index in steps)
    assert Counter(operation for operation, _, _ in steps)["equalize"] == 17


@pytest.mark.parametrize(
    ("operation", "index", "value"),
    [
        ("rotate", 9, 30.0),
        ("rotate", 3, 10.0),
        ("shear_x", 5, 0.3 * 5 / 9),
        ("posterize", 8, 4),
        ("posterize", 7, 5),
        ("posterize", 6, 5),
        ("posterize", 5, 6),
        ("solarize", 0, 256.0),
        ("solarize", 5, 256 * 4 / 9),
        ("colour", 4, 0.4),
        ("contrast", 8, 0.8),
        ("sharpness", 7, 0.7),
    ],
)
def test_magnitude_by_hand(operation: Operation, index: int, value: float) -> None:
    assert magnitude(operation, index) == pytest.approx(value)


def test_posterize_keeps_the_upper_bits() -> None:
    assert np.array_equal(applied("posterize", 8), RAMP // 16 * 16)
    assert np.array_equal(applied("posterize", 0), RAMP)


def test_solarize_inverts_from_the_threshold_on() -> None:
    threshold = 256 * 4 / 9  # 113.8
    assert np.array_equal(applied("solarize", 5), np.where(threshold > RAMP, RAMP, 255 - RAMP))
    assert np.array_equal(applied("solarize", 0), RAMP)
    assert np.array_equal(applied("solarize", 9), 255 - RAMP)


def test_invert_and_stretches_by_hand() -> None:
    assert np.array_equal(applied("invert"), 255 - RAMP)
    narrow = RAMP // 4 + 50  # 50 to 113
    assert applied("autocontrast", image=narrow).min() == 0
    assert applied("autocontrast", image=narrow).max() >= 254  # cut, not rounded
    assert np.array_equal(applied("equalize"), RAMP)


def test_rotate_turns_counterclockwise_onto_grey() -> None:
    mark = np.zeros((61, 61, 3), np.uint8)
    mark[28:33, 48:53] = 255  # 20 pixels to the east
    for sign in (1, -1):
        turned = applied("rotate", 9, sign, mark)
        rows, columns = np.nonzero(turned[..., 0] == 255)
        assert rows.mean() == pytest.approx(30 - 20 * np.sin(np.radians(30)), abs=0.7)
        assert columns.mean() == pytest.approx(30 + 20 * np.cos(np.radians(30)), abs=0.7)
        assert turned[0, 0].tolist() == [128, 128, 128]


@pytest.mark.parametrize("sign", [1, -1])
def test_shear_shifts_rows_in_proportion(sign: int) -> None:
    line = np.zeros((60, 60, 3), np.uint8)
    line[:, 30] = 255
    sheared = applied("shear_x", 5, sign, line)
    for row in (6, 24, 42):
        centre = (sheared[row, 10:50, 0] * np.arange(10, 50)).sum() / sheared[row, 10:50, 0].sum()
        assert centre == pytest.approx(30 - sign * (row + 0.5) / 6, abs=0.6)


def test_enhancements_move_both_ways_from_one() -> None:
    red = np.full((4, 4, 3), (200, 0, 0), np.uint8)
    less = applied("colour", 4, -1, red)[0, 0].astype(int)
    assert less[0] - less[1] == pytest.approx(0.6 * 200, abs=1.5)
    assert np.array_equal(applied("colour", 0, 1, red), red)
    assert np.ptp(applied("contrast", 8, -1)) == pytest.approx(0.2 * 255, abs=1.5)
    edge = np.zeros((9, 9, 3), np.uint8)
    edge[:, 4:] = 100
    assert applied("sharpness", 7, 1, edge).max() > 100
    assert applied("sharpness", 7, -1, edge)[4, 4, 0] < 100


def test_auto_augment_is_a_function_of_its_generator() -> None:
    before = RAMP.copy()
    once, again = (
        [auto_augment(RAMP, np.random.default_rng(seed)) for seed in range(60)] for _ in range(2)
    )
    assert all(np.array_equal(one, other) for one, other in zip(once, again, strict=True))
    assert all(image.shape == RAMP.shape and image.dtype == np.uint8 for image in once)
    assert len({image.tobytes() for image in once}) > 10
    assert np.array_equal(RAMP, before)
