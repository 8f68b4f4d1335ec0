"""Augmentation, on images whose every pixel holds its row and column.

Shapes: H x W pixels.
"""

from dataclasses import replace
from math import atan2, degrees

import numpy as np
import pytest

from pipeline.core.arrays import Pixels
from pipeline.core.errors import InputError
from pipeline.core.records import View
from pipeline.images.augmentation import Augmentation, augment, change_colours, change_look
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


@pytest.mark.parametrize("mirrored", [False, True])
def test_augment_repeats_the_edge_as_numpy_pads(mirrored: bool) -> None:
    image_HW3 = noise(SIZE, SIZE)[:, ::-1] if mirrored else noise(SIZE, SIZE)
    padded_HW3 = np.pad(image_HW3, ((PAD, PAD), (PAD, PAD), (0, 0)), mode="edge")
    for seed in range(20):
        found_HW3 = augment(image_HW3, View.DRONE, SIZE, BARE, np.random.default_rng(seed))
        top, left = np.random.default_rng(seed).integers(0, 2 * PAD, size=2, endpoint=True)
        assert np.array_equal(found_HW3, padded_HW3[top : top + SIZE, left : left + SIZE])


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


# The affine geometry and the looks.

AFFINE = Augmentation(pad=0, rotation=180, mirror=False, affine=True, drone_rotation=10)


def test_affine_without_moves_changes_nothing() -> None:
    still = Augmentation(pad=0, rotation=0, mirror=False, affine=True)
    for view in (View.DRONE, View.SATELLITE):
        for image_HW3 in augmented(view, still, 3, noise()):
            assert np.array_equal(image_HW3, resize(noise(), SIZE))


def test_affine_turns_satellites_any_way_without_black_corners() -> None:
    white_HW3 = np.full((SIZE, SIZE, 3), 255, np.uint8)
    moves = replace(AFFINE, scale=0.3, shift=0.2)
    assert all((image_HW3 == 255).all() for image_HW3 in
               augmented(View.SATELLITE, moves, 50, white_HW3))  # fmt: skip
    # A bright upper half is found on all four sides.
    half_HW3 = np.zeros((SIZE, SIZE, 3), np.uint8)
    half_HW3[: SIZE // 2] = 255
    turned = augmented(View.SATELLITE, AFFINE, 100, half_HW3)
    sides = [(im[:4].mean(), im[-4:].mean(), im[:, :4].mean(), im[:, -4:].mean()) for im in turned]
    assert {int(np.argmax(side)) for side in sides} == {0, 1, 2, 3}
    rolled = augmented(View.DRONE, AFFINE, 100, half_HW3)
    assert all(int(np.argmax([im[:4].mean(), im[-4:].mean()])) == 0 for im in rolled)


def test_affine_scale_is_symmetric_around_one() -> None:
    dot_HW3 = np.zeros((64, 64, 3), np.uint8)
    dot_HW3[24:40, 24:40] = 255
    scaled = [
        augment(dot_HW3, View.DRONE, 64, Augmentation(pad=0, mirror=False, affine=True, scale=0.5),
                np.random.default_rng(seed)) for seed in range(200)
    ]  # fmt: skip
    areas = np.array([(image_HW3[..., 0] > 127).sum() / 256 for image_HW3 in scaled])
    assert 1 / 1.5**2 - 0.15 < areas.min() < 0.6
    assert 1.7 < areas.max() < 1.5**2 + 0.3
    assert abs(np.log(areas).mean()) < 0.1


def test_colours_at_strength_0_stay() -> None:
    values = noise().astype(np.float32)
    kept = change_colours(values.copy(), 0.0, np.random.default_rng(0))
    np.testing.assert_allclose(kept, values, atol=1e-3)
    changed = [change_colours(values.copy(), 1.0, np.random.default_rng(seed)) for seed in range(9)]
    assert len({float(one.mean()) for one in changed}) == 9


@pytest.mark.parametrize(
    "look",
    [Augmentation(blur=3.0), Augmentation(noise=20.0), Augmentation(jpeg=1), Augmentation(hide=1)],
)
def test_each_look_changes_an_image_and_keeps_its_size(look: Augmentation) -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        found = change_look(noise(), look, rng)
        assert found.shape == noise().shape
        assert found.dtype == np.uint8
    assert not np.array_equal(found, noise())
    assert np.array_equal(change_look(noise(), Augmentation(), rng), noise())


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"scale": 0.2}, "expected --affine too"),
        ({"hide": 1.5}, "--hide is 1.5, expected 0 to 1"),
        ({"blur": -1.0}, "--blur is -1.0, expected 0 or more"),
    ],
)
def test_augmentation_rejects(settings: dict[str, float], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        replace(Augmentation(), **settings)  # type: ignore[arg-type]
