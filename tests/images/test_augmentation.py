"""Augmentation, on images whose every pixel holds its row and column.

Shapes: H x W pixels.
"""

from math import atan2, degrees

import numpy as np
import pytest

from pipeline.core.arrays import Pixels
from pipeline.core.records import View
from pipeline.images.augmentation import Augmentation, augment
from pipeline.images.transforms import resize


def noise(height: int = 37, width: int = 50) -> Pixels:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


SIZE, PAD = 12, 3
SIDE = np.arange(SIZE)
MAP: Pixels = np.stack(
    [*np.meshgrid(SIDE, SIDE, indexing="ij"), np.full((SIZE, SIZE), 9)], axis=2
).astype(np.uint8)
"An image whose pixels hold their row and column."
BARE = Augmentation(pad=PAD, rotation=0, mirror=False)


def augmented(
    view: View, settings: Augmentation, seeds: int, image_HW3: Pixels = MAP
) -> list[Pixels]:
    return [
        augment(image_HW3, view, SIZE, settings, np.random.default_rng(seed))
        for seed in range(seeds)
    ]


def shifted(down: int, right: int) -> Pixels:
    """The map, shifted, its edge repeated."""
    rows, columns = (np.clip(SIDE + by, 0, SIZE - 1) for by in (down, right))
    return MAP[rows][:, columns]


def test_augmentation_defaults_are_the_papers() -> None:
    assert Augmentation() == Augmentation(pad=10, rotation=90.0, mirror=True)


def test_augment_crops_anywhere_in_the_padded_image() -> None:
    possible = {
        shifted(down, right).tobytes(): (down, right)
        for down in range(-PAD, PAD + 1)
        for right in range(-PAD, PAD + 1)
    }
    seen = {
        possible[np.ascontiguousarray(image_HW3).tobytes()]
        for image_HW3 in augmented(View.DRONE, BARE, 400)
    }
    assert {down for down, _ in seen} == {right for _, right in seen} == set(range(-PAD, PAD + 1))
    assert len(seen) == 49


def test_augment_mirrors_half_and_turns_no_drone_image() -> None:
    mirrored = 0
    for image_HW3 in augmented(View.DRONE, Augmentation(pad=PAD), 400):
        leftward = int(image_HW3[0, 0, 1]) > int(image_HW3[0, -1, 1])
        mirrored += leftward
        straight_HW3 = image_HW3[:, ::-1] if leftward else image_HW3
        assert (straight_HW3 == straight_HW3[:, :1])[:, :, 0].all()  # rows stay rows
        assert (straight_HW3 == straight_HW3[:1])[:, :, 1].all()
    assert 150 < mirrored < 250


def test_augment_with_all_steps_off_only_resizes() -> None:
    [image_HW3] = augmented(
        View.SATELLITE, Augmentation(pad=0, rotation=0, mirror=False), 1, noise()
    )
    assert np.array_equal(image_HW3, resize(noise(), SIZE))


def test_augment_turns_a_satellite_image_by_up_to_90_degrees() -> None:
    size, centre = 65, 32
    field_HW3 = np.zeros((size, size, 3), np.uint8)
    field_HW3[centre - 2 : centre + 3, centre + 20 : centre + 25] = 255  # a mark to the east
    angles = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        image_HW3 = augment(field_HW3, View.SATELLITE, size, Augmentation(pad=0, mirror=False), rng)
        rows, columns = np.nonzero(image_HW3[:, :, 0])
        angles.append(degrees(atan2(centre - rows.mean(), columns.mean() - centre)))
    assert all(-92 < angle < 92 for angle in angles)
    counts = np.histogram(angles, bins=[-92, -60, -30, 0, 30, 60, 92])[0]
    assert (counts > 15).all()


def test_augment_pads_before_turning_and_leaves_corners_black() -> None:
    white_HW3 = np.full((SIZE, SIZE, 3), 255, np.uint8)
    for image_HW3 in augmented(View.SATELLITE, Augmentation(pad=PAD), 50, white_HW3):
        assert set(np.unique(image_HW3).tolist()) <= {0, 255}
    assert any(
        (image_HW3 == 0).any()
        for image_HW3 in augmented(View.SATELLITE, Augmentation(pad=PAD), 50, white_HW3)
    )
    for image_HW3 in augmented(View.SATELLITE, Augmentation(pad=40), 50, white_HW3):
        assert image_HW3[4:8, 4:8].all() or (image_HW3 == 0).any()
    assert all(
        (image_HW3 == 255).all()
        for image_HW3 in augmented(View.DRONE, Augmentation(pad=PAD), 50, white_HW3)
    )


@pytest.mark.parametrize("view", [View.DRONE, View.SATELLITE])
def test_augment_depends_on_its_random_numbers_alone(view: View) -> None:
    once, again = (augmented(view, Augmentation(pad=PAD), 20) for _ in range(2))
    assert all(np.array_equal(one, other) for one, other in zip(once, again, strict=True))
    assert len({image_HW3.tobytes() for image_HW3 in once}) > 10


def test_augment_gives_one_block_of_memory_of_the_size() -> None:
    for view in (View.DRONE, View.SATELLITE):
        for image_HW3 in augmented(view, Augmentation(), 4, noise()):
            assert image_HW3.shape == (SIZE, SIZE, 3)
            assert image_HW3.dtype == np.uint8
            assert image_HW3.flags.c_contiguous
