"""Square rings: LPN's boxes, a partition of maps of any size, and LPN's averages where LPN's own
code is right.

Shapes: B images, C channels, H x W cells, P rings.
"""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from model.parts.ring_pooling import ring_average, ring_masks

PARTS = st.integers(1, 5)
BEYOND = st.integers(0, 20)


def lpn_averages(maps_BCHW: Tensor, parts: int) -> Tensor:
    """As LPN computes them on even square maps: each box with the smaller one set to zero, averaged
    over the box.
    """
    side = maps_BCHW.shape[2]
    centre, per = side // 2, side // (2 * parts)
    rings = []
    for part in range(1, parts + 1):
        box_BCHW = maps_BCHW.clone()
        hole = slice(centre - (part - 1) * per, centre + (part - 1) * per)
        box_BCHW[:, :, hole, hole] = 0
        if part < parts:
            inside = slice(centre - part * per, centre + part * per)
            box_BCHW = box_BCHW[:, :, inside, inside]
        rings.append(box_BCHW.mean((2, 3)))
    return torch.stack(rings, dim=1)


@pytest.mark.parametrize(
    ("side", "boxes"),
    [
        (16, [(6, 10), (4, 12), (2, 14), (0, 16)]),
        (24, [(9, 15), (6, 18), (3, 21), (0, 24)]),
    ],
)
def test_ring_masks_equal_lpns_at_256_and_384(side: int, boxes: list[tuple[int, int]]) -> None:
    seen_HW = torch.zeros(side, side)
    for mask_HW, (start, stop) in zip(ring_masks(side, side, 4), boxes, strict=True):
        box_HW = torch.zeros(side, side)
        box_HW[start:stop, start:stop] = 1
        assert torch.equal(mask_HW, box_HW - seen_HW)
        seen_HW = box_HW


@settings(max_examples=50)
@given(parts=PARTS, tall=BEYOND, wide=BEYOND)
def test_ring_masks_partition_any_map(parts: int, tall: int, wide: int) -> None:
    masks_PHW = ring_masks(2 * parts + tall, 2 * parts + wide, parts)
    assert masks_PHW.shape == (parts, 2 * parts + tall, 2 * parts + wide)
    assert torch.equal(masks_PHW.sum(0), torch.ones(masks_PHW.shape[1:]))
    assert bool((masks_PHW.sum((1, 2)) > 0).all())


@settings(max_examples=50)
@given(parts=PARTS, tall=BEYOND, wide=BEYOND)
def test_ring_masks_of_flipped_map_are_equal(parts: int, tall: int, wide: int) -> None:
    masks_PHW = ring_masks(2 * parts + tall, 2 * parts + wide, parts)
    assert torch.equal(masks_PHW, masks_PHW.flip(1))
    assert torch.equal(masks_PHW, masks_PHW.flip(2))


@settings(max_examples=50)
@given(parts=PARTS, tall=BEYOND)
def test_ring_masks_of_transposed_map_are_transposed(parts: int, tall: int) -> None:
    upright_PHW = ring_masks(2 * parts + tall, 2 * parts + 3, parts)
    assert torch.equal(
        upright_PHW.transpose(1, 2), ring_masks(2 * parts + 3, 2 * parts + tall, parts)
    )


def test_ring_masks_of_odd_map_are_centred() -> None:
    rows = [mask_HW.any(1).nonzero().flatten().tolist() for mask_HW in ring_masks(17, 17, 4)]
    assert [(row[0], row[-1] + 1) for row in rows] == [(6, 11), (4, 13), (2, 15), (0, 17)]


def test_ring_average_box_divisor_fractions() -> None:
    ones_BCHW = torch.ones(1, 1, 16, 16)
    assert ring_average(ones_BCHW, 4, "box").flatten().tolist() == pytest.approx(
        [1, 3 / 4, 5 / 9, 7 / 16]
    )
    assert [round(share, 4) for share in (1, 3 / 4, 5 / 9, 7 / 16)] == [1, 0.75, 0.5556, 0.4375]
    assert ring_average(ones_BCHW, 4, "ring").flatten().tolist() == pytest.approx([1, 1, 1, 1])


@pytest.mark.parametrize(
    ("side", "parts"), [(16, 4), (24, 4), (18, 4), (8, 4), (4, 2), (12, 3), (6, 1)]
)
def test_ring_average_equals_lpns_boxes(side: int, parts: int) -> None:
    maps_BCHW = torch.randn(2, 3, side, side, generator=torch.Generator().manual_seed(side))
    torch.testing.assert_close(
        ring_average(maps_BCHW, parts, "box"), lpn_averages(maps_BCHW, parts)
    )


def test_ring_average_orders_rings_from_the_centre() -> None:
    rings_PHW = ring_masks(9, 12, 2)
    maps_BCHW = torch.stack([rings_PHW[0] * 5, rings_PHW[1] * 7])[None]
    assert ring_average(maps_BCHW, 2, "ring")[0].tolist() == [[5, 0], [0, pytest.approx(7)]]


def test_ring_average_keeps_the_dtype() -> None:
    assert ring_average(torch.ones(1, 1, 4, 4, dtype=torch.bfloat16), 2).dtype == torch.bfloat16


@pytest.mark.parametrize(("height", "width"), [(7, 16), (16, 7), (1, 1)])
def test_ring_masks_reject_small_map(height: int, width: int) -> None:
    with pytest.raises(
        ValueError,
        match=rf"{height} x {width} cells cannot hold 4 .*at least 8 .*larger images or fewer",
    ):
        ring_masks(height, width, 4)
