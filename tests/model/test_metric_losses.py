"""Losses of the compared methods, against loops and hand-worked cases."""

import math

import pytest
import torch
from torch import Tensor

from model.losses.consistency import dense_alignment, view_js, view_kl
from model.losses.metric import cross_view_triplet, multi_similarity


def unit(values: Tensor) -> Tensor:
    lengths: Tensor = torch.linalg.vector_norm(values, dim=-1, keepdim=True)
    return values / (lengths + 1e-6)


def triplet_by_loops(one: Tensor, labels1: Tensor, other: Tensor, labels2: Tensor) -> float:
    """FSRA's, an anchor at a time."""
    hinges = []
    for part in range(one.shape[1]):
        first, second = unit(one[:, part]), unit(other[:, part])
        for anchors, own, rest, theirs in (
            (first, labels1, second, labels2),
            (second, labels2, first, labels1),
        ):
            for anchor, label in zip(anchors, own, strict=True):
                distances = [
                    math.sqrt(max(float((anchor - row).square().sum()), 1e-6)) for row in rest
                ]
                near = [d for d, its in zip(distances, theirs, strict=True) if its != label]
                far = [d for d, its in zip(distances, theirs, strict=True) if its == label]
                hinges.append(max(0.0, max(far) - min(near) + 0.3) if near and far else 0.0)
    return sum(hinges) / len(hinges)


@pytest.mark.parametrize("labels2", [[0, 1, 2, 3], [3, 3, 1, 0], [0, 0, 1, 1]])
def test_triplet_equals_loop_over_anchors(labels2: list[int]) -> None:
    torch.manual_seed(1)
    one, other = torch.randn(4, 3, 5), torch.randn(4, 3, 5)
    labels1, second = torch.tensor([0, 1, 2, 3]), torch.tensor(labels2)
    found = cross_view_triplet(one, labels1, other, second, 0.3)
    assert float(found) == pytest.approx(triplet_by_loops(one, labels1, other, second), abs=1e-5)


def test_triplet_of_equal_views_has_finite_gradients() -> None:
    g_BPD = torch.randn(3, 2, 4, requires_grad=True)
    labels_B = torch.arange(3)
    loss = cross_view_triplet(g_BPD, labels_B, g_BPD, labels_B, 0.3)
    loss.backward()  # type: ignore[no-untyped-call]
    assert g_BPD.grad is not None
    assert bool(g_BPD.grad.isfinite().all())


def similarity_by_loops(rows: Tensor, labels: list[int]) -> float:
    cosines = torch.cosine_similarity(rows[:, None], rows[None], dim=2).tolist()
    total = 0.0
    for i, label in enumerate(labels):
        positives = [cosines[i][j] for j in range(len(labels)) if j != i and labels[j] == label]
        negatives = [cosines[i][j] for j in range(len(labels)) if labels[j] != label]
        pull = [s for s in positives if negatives and s - 0.4 < max(negatives)]
        push = [s for s in negatives if not positives or s + 0.4 > min(positives)]
        push = push if positives else []
        total += math.log1p(sum(math.exp(-5 * (s - 0.1)) for s in pull)) / 5
        total += math.log1p(sum(math.exp(100 * (s - 0.1)) for s in push)) / 100
    return total / len(labels)


@pytest.mark.parametrize("labels", [[0, 1, 0, 1], [0, 1, 2, 0], [0, 0, 0, 0]])
def test_multi_similarity_equals_loop(labels: list[int]) -> None:
    torch.manual_seed(2)
    rows = torch.randn(4, 6)
    found = multi_similarity(rows, torch.tensor(labels))
    assert float(found) == pytest.approx(similarity_by_loops(rows, labels), abs=1e-5)


def test_view_kl_is_the_divergence_by_hand() -> None:
    drone = torch.tensor([[[0.75, 0.25]]]).log()
    satellite = torch.tensor([[[0.5, 0.5]]]).log()
    by_hand = 0.75 * math.log(1.5) + 0.25 * math.log(0.5)
    assert float(view_kl(drone, satellite)) == pytest.approx(by_hand)
    assert float(view_kl(drone, drone)) == pytest.approx(0, abs=1e-7)


def test_view_js_of_agreeing_views_pulls_nowhere() -> None:
    logits = torch.randn(3, 2, 5)
    one, other = logits.clone().requires_grad_(), logits.clone().requires_grad_()
    loss = view_js(one, other)
    loss.backward()  # type: ignore[no-untyped-call]
    assert float(loss.detach()) == pytest.approx(0, abs=1e-6)
    assert one.grad is not None
    assert float(one.grad.abs().max()) < 1e-6


def test_dense_alignment_of_equal_and_opposite_maps() -> None:
    maps_BKN = torch.randn(2, 3, 4)
    assert float(dense_alignment(maps_BKN, 2 * maps_BKN)) == pytest.approx(0, abs=1e-6)
    assert float(dense_alignment(maps_BKN, -maps_BKN)) == pytest.approx(2)
