"""The steps of other methods' augmentation, by hand-worked cases; their chains as a function of the
generator.

Shapes: H x W pixels.
"""

from dataclasses import replace
from math import exp, radians

import numpy as np
import pytest

from pipeline.core.arrays import Pixels
from pipeline.core.errors import InputError
from pipeline.core.records import View
from pipeline.images.augmentation import Augmentation, Chain, augment
from pipeline.images.chains import (
    MEAN_COLOUR,
    JitterRanges,
    blur_anisotropically,
    compress,
    drop_grid,
    drop_rectangles,
    erase,
    gaussian_kernel,
    jitter_colours,
    mccg_colours,
    resize_bilinear,
    sample4geo_chain,
    sharpen,
    sharpening_kernel,
    shift_hue,
)

NOISE: Pixels = np.random.default_rng(0).integers(0, 256, (50, 60, 3), dtype=np.uint8)
WHITE: Pixels = np.full((100, 100, 3), 255, np.uint8)


def flat(*colour: int) -> Pixels:
    return np.full((4, 4, 3), colour, np.uint8)


def generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.mark.parametrize(
    ("turn", "colour"),
    [
        (0.0, (255, 0, 0)),
        (1 / 3, (0, 255, 0)),
        (-1 / 3, (0, 0, 255)),
        (1 / 6, (255, 255, 0)),
        (1.0, (255, 0, 0)),
    ],
)
def test_hue_shift_of_red(turn: float, colour: tuple[int, int, int]) -> None:
    assert np.array_equal(shift_hue(flat(255, 0, 0), turn), flat(*colour))


def test_hue_shift_keeps_grey() -> None:
    assert np.array_equal(shift_hue(flat(90, 90, 90), 0.25), flat(90, 90, 90))


NONE = JitterRanges(brightness=0, contrast=0, saturation=0, hue=0)


def test_jitter_without_ranges_changes_nothing() -> None:
    assert np.array_equal(jitter_colours(NOISE, NONE, generator()), NOISE)


def test_jitter_brightness_scales_bytes() -> None:
    found = {
        int(jitter_colours(flat(100, 100, 100), replace(NONE, brightness=0.15), generator(s)).max())
        for s in range(200)
    }
    assert 85 <= min(found) <= 88
    assert 112 <= max(found) <= 115


def test_jitter_contrast_keeps_the_mean_grey() -> None:
    halves_HW3 = np.concatenate([flat(80, 80, 80), flat(120, 120, 120)])
    for seed in range(20):
        found = jitter_colours(halves_HW3, replace(NONE, contrast=0.5), generator(seed))
        below, above = int(found[0, 0, 0]), int(found[-1, 0, 0])
        assert below + above in (199, 200, 201)
        assert 18 <= above - below <= 62  # 40 (1 +- 0.5), rounded twice


def test_jitter_saturation_keeps_grey_and_moves_colour() -> None:
    wide = replace(NONE, saturation=0.5)
    assert np.array_equal(jitter_colours(flat(70, 70, 70), wide, generator()), flat(70, 70, 70))
    # Pure red has grey 76: 255 and 0 move from it by a factor.
    for seed in range(20):
        red, green, _ = jitter_colours(flat(200, 0, 0), wide, generator(seed))[0, 0].astype(int)
        factor = (red - green) / 200
        assert 0.5 <= factor <= 1.28  # then red is above 255 or green below 0
        assert green == max(0, round(60 * (1 - factor))) or abs(green - 60 * (1 - factor)) < 1.5


def test_sharpening_kernel_by_hand() -> None:
    kernel_33 = sharpening_kernel(0.25, 1.0)
    assert kernel_33.sum() == pytest.approx(1.0)
    assert kernel_33[1, 1] == pytest.approx(0.75 + 0.25 * 9)
    assert (np.delete(kernel_33, 4) == -0.25).all()
    assert sharpening_kernel(0.4, 0.5).sum() == pytest.approx(0.8)


def test_sharpen_darkens_a_flat_image_by_the_kernels_sum() -> None:
    found = {int(sharpen(flat(200, 200, 200), generator(s)).mean()) for s in range(100)}
    assert 150 <= min(found) < 170  # 1 - 0.5 * 0.5
    assert 190 < max(found) <= 200


def test_gaussian_kernel_by_hand() -> None:
    kernel_33 = gaussian_kernel(3, 0.5, 1.0, 0.0, 1.0)
    assert kernel_33[1, 1] == 1
    assert kernel_33[1, 2] == pytest.approx(exp(-2))  # a step along x, sigma 0.5
    assert kernel_33[2, 1] == pytest.approx(exp(-0.5))
    assert kernel_33[2, 2] == pytest.approx(exp(-2.5))
    turned_33 = gaussian_kernel(3, 0.5, 1.0, radians(90), 1.0)
    assert turned_33[2, 1] == pytest.approx(exp(-2))
    peaked_33 = gaussian_kernel(3, 1.0, 1.0, radians(30), 2.0)
    assert peaked_33[0, 1] == pytest.approx(exp(-0.5))
    assert peaked_33[0, 0] == pytest.approx(exp(-0.5 * 4))


def test_blur_keeps_a_flat_image_and_smooths_noise() -> None:
    assert np.array_equal(blur_anisotropically(flat(9, 99, 199), generator()), flat(9, 99, 199))
    blurred = [blur_anisotropically(NOISE, generator(seed)) for seed in range(20)]
    assert all(image_HW3.std() <= NOISE.std() + 1 for image_HW3 in blurred)
    assert min(image_HW3.std() for image_HW3 in blurred) < 0.7 * NOISE.std()


def test_grid_at_100_px_is_100_squares_of_4() -> None:
    dropped = drop_grid(WHITE)[..., 0] == 0
    assert dropped.sum() == 100 * 4 * 4
    assert dropped[:4, :4].all()
    assert not dropped[4:10].any()
    assert dropped[90:94, 90:94].all()
    assert (WHITE == 255).all()


def test_grid_at_384_px_begins_an_eleventh_cell() -> None:
    dropped = drop_grid(np.full((384, 384, 3), 255, np.uint8))[..., 0] == 0
    assert dropped[0].sum() == 10 * 15 + 4  # cells of 38, holes of 15, 4 pixels left over


def test_rectangles_cover_what_their_ranges_allow() -> None:
    shares = [(drop_rectangles(WHITE, generator(s)) == 0).mean() for s in range(100)]
    assert min(shares) > 0.01  # one of 10 x 10 at the least
    assert max(shares) < 25 * 0.04
    assert 0.2 < np.mean(shares) < 0.4  # 17.5 of 15 x 15, some over each other
    once = drop_rectangles(WHITE, generator())
    assert set(np.unique(once).tolist()) == {0, 255}


def test_erasing_keeps_to_its_area_and_aspect() -> None:
    areas = []
    for seed in range(200):
        erased = (erase(WHITE, generator(seed)) == MEAN_COLOUR).all(axis=2)
        rows, columns = erased.any(axis=1).sum(), erased.any(axis=0).sum()
        assert erased.sum() == rows * columns
        assert 0.27 < rows / columns < 3.7  # 0.3 to 1 / 0.3, rounded to pixels
        areas.append(erased.mean())
    assert 0.018 < min(areas) < 0.05
    assert 0.3 < max(areas) < 0.41


def test_compression_of_quality_100_is_close() -> None:
    smooth_HW3 = np.repeat(np.arange(64, dtype=np.uint8)[:, None, None], 64, 1).repeat(3, 2)
    assert np.abs(compress(smooth_HW3, 100).astype(int) - smooth_HW3).max() <= 1
    assert not np.array_equal(compress(NOISE, 90), NOISE)


def test_bilinear_resize_by_hand() -> None:
    quarters_HW3 = np.array([[0, 100], [100, 200]], np.uint8)[..., None].repeat(3, 2)
    assert resize_bilinear(quarters_HW3, 1).tolist() == [[[100, 100, 100]]]
    assert resize_bilinear(quarters_HW3, 4)[0, :, 0].tolist() == [0, 25, 75, 100]
    # Without antialiasing a lone bright row between the sampled ones disappears.
    stripes_HW3 = np.zeros((40, 40, 3), np.uint8)
    stripes_HW3[::10] = 255
    assert not resize_bilinear(stripes_HW3, 4).any()


@pytest.mark.parametrize("chain", ["sample4geo", "dac", "mccg"])
@pytest.mark.parametrize("view", [View.DRONE, View.SATELLITE])
def test_chain_is_a_function_of_its_generator(chain: Chain, view: View) -> None:
    settings, before = Augmentation(chain=chain), NOISE.copy()
    once, again = (
        [augment(NOISE, view, 32, settings, generator(seed)) for seed in range(30)]
        for _ in range(2)
    )
    for image_HW3, same_HW3 in zip(once, again, strict=True):
        assert image_HW3.shape == (32, 32, 3)
        assert image_HW3.dtype == np.uint8
        assert image_HW3.flags.c_contiguous
        assert np.array_equal(image_HW3, same_HW3)
    assert len({image_HW3.tobytes() for image_HW3 in once}) > 15
    assert np.array_equal(NOISE, before)


def test_chain_turns_satellites_alone_by_quarters() -> None:
    half_HW3 = np.zeros((60, 60, 3), np.uint8)
    half_HW3[:30] = 200

    def brightest(view: View) -> list[int]:
        images = [sample4geo_chain(half_HW3, view, 60, False, generator(s)) for s in range(200)]
        sides = [(im[:30], im[30:], im[:, :30], im[:, 30:]) for im in images]
        return [int(np.argmax([part.mean() for part in side])) for side in sides]

    assert set(brightest(View.DRONE)) == {0}
    assert np.bincount(brightest(View.SATELLITE)).min() > 30


def test_jitter_is_the_methods_and_the_views(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[tuple[View, bool], set[JitterRanges]] = {}

    def note(image_HW3: Pixels, ranges: JitterRanges, _: np.random.Generator) -> Pixels:
        seen.setdefault((view, wide), set()).add(ranges)
        return image_HW3

    monkeypatch.setattr("pipeline.images.chains.jitter_colours", note)
    for view in (View.DRONE, View.SATELLITE):
        for wide in (False, True):
            for seed in range(10):
                sample4geo_chain(NOISE, view, 32, wide, generator(seed))
    narrow = replace(NONE, brightness=0.15, contrast=0.15, saturation=0.15, hue=0.15)
    assert seen[View.DRONE, False] == seen[View.SATELLITE, False] == {narrow}
    broad = replace(NONE, brightness=0.15, contrast=0.3, saturation=0.3, hue=0.3)
    assert seen[View.SATELLITE, True] == {broad}
    assert seen[View.DRONE, True] == {replace(broad, contrast=0.7)}


def test_mccg_jitters_satellites_a_little() -> None:
    for seed in range(20):
        found = mccg_colours(flat(100, 100, 100), View.SATELLITE, generator(seed))
        assert 88 <= found.min() == found.max() <= 111


def test_mccg_erases_half_of_the_uav_images_alone() -> None:
    settings = Augmentation(chain="mccg", pad=0, rotation=0, mirror=False)

    def erased(view: View) -> int:
        images = [augment(WHITE // 5, view, 50, settings, generator(s)) for s in range(200)]
        return sum(bool((im == MEAN_COLOUR).all(axis=2).any()) for im in images)

    assert 70 < erased(View.DRONE) < 130
    assert erased(View.SATELLITE) == 0


@pytest.mark.parametrize("view", [View.DRONE, View.SATELLITE])
def test_erasing_by_itself_leaves_the_rest_as_it_was(view: View) -> None:
    for seed in range(5):
        plain_HW3 = augment(NOISE, view, 40, Augmentation(), generator(seed))
        erased_HW3 = augment(NOISE, view, 40, Augmentation(erase=1), generator(seed))
        covered = (erased_HW3 == MEAN_COLOUR).all(axis=2)
        assert 0 < covered.mean() < 0.5
        assert np.array_equal(erased_HW3[~covered], plain_HW3[~covered])


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"chain": "dac", "blur": 2.0}, "--blur 2.0 with --chain dac, where it has no effect"),
        ({"chain": "sample4geo", "pad": 4}, "expected its default 10"),
        ({"chain": "mccg", "erase": 0.5}, "--erase with --chain mccg"),
        ({"erase": 2.0}, "--erase is 2.0, expected 0 to 1"),
    ],
)
def test_chain_rejects_settings_without_effect(settings: dict[str, object], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        Augmentation(**settings)  # type: ignore[arg-type]


def test_chain_takes_steps_switched_off() -> None:
    off = Augmentation(chain="dac", pad=0, rotation=0, mirror=False, erase=0.5, pair_mirror=True)
    assert off.chain == "dac"
