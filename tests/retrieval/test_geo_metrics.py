"""Distances and SDM@K against numbers worked by hand."""

import math

import numpy as np
import pytest

from pipeline.core.geo import EARTH_RADIUS_M, haversine_m
from pipeline.retrieval.geo_metrics import distance_metrics, spatial_distance_metric

DEGREE_M = math.pi / 180 * EARTH_RADIUS_M


def test_haversine_of_a_degree_of_meridian_and_parallel() -> None:
    assert haversine_m(np.array([10.0, 20]), np.array([11.0, 20])) == pytest.approx(DEGREE_M)
    assert haversine_m(np.array([60.0, 20]), np.array([60.0, 20.001])) == pytest.approx(
        DEGREE_M / 2000, rel=1e-6
    )
    assert haversine_m(np.array([0.0, 179.5]), np.array([0.0, -179.5])) == pytest.approx(DEGREE_M)
    assert haversine_m(np.array([90.0, 0]), np.array([-90.0, 0])) == pytest.approx(
        math.pi * EARTH_RADIUS_M
    )


def test_sdm_weighs_first_answers_most_and_falls_with_distance() -> None:
    place = np.array([[30.0, 120.0]])
    near, far = [30.0002, 120.0], [31.0, 121.0]
    assert spatial_distance_metric(place, np.array([[[30.0, 120.0]]])) == pytest.approx(1)
    assert spatial_distance_metric(place, np.array([[near]])) == pytest.approx(math.exp(-1))
    found = spatial_distance_metric(place, np.array([[near, far, [30.0, 120.0]]]))
    assert found == pytest.approx((3 * math.exp(-1) + 2 * 0 + 1) / 6)


def test_distance_metrics_use_queries_of_known_position() -> None:
    queries = np.array([[0.0, 0], [0.0, 0], [0.0, 0], [np.nan, np.nan]])
    metres = np.array([0, 30, 200, 0]) / DEGREE_M
    answers = np.stack([np.stack([metres, np.zeros(4)], axis=1)] * 3, axis=1)
    found = distance_metrics(queries, answers, np.array(["a", "b", "c", "d"]))
    assert found["geo_queries"] == 3
    assert found["distance_median_m"] == pytest.approx(30)
    assert found["distance_p90_m"] == pytest.approx(30 + 0.8 * 170)
    within = [found[f"within_{metres}m"] for metres in (1, 5, 25, 50, 100)]
    assert within == pytest.approx([1 / 3, 1 / 3, 1 / 3, 2 / 3, 2 / 3])
    # Three places: a share of a third is within none to all, and so is every quantile.
    assert (found["within_5m_low"], found["within_5m_high"]) == (0, 1)
    assert found["distance_median_m_low"] == pytest.approx(0)
    assert found["distance_median_m_high"] == pytest.approx(200)
    assert found["sdm3"] == pytest.approx(np.mean(np.exp(-5e3 * metres[:3])))
    assert found["sdm5"] is None


def test_distance_metrics_of_a_partly_tagged_gallery_are_none() -> None:
    found = distance_metrics(
        np.zeros((2, 2)), np.array([[[0.0, 0]], [[np.nan, np.nan]]]), np.array(["a", "b"])
    )
    assert found["geo_queries"] == 0
    assert {value for name, value in found.items() if name != "geo_queries"} == {None}
