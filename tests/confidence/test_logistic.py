"""The two probability models: their formulas, and that no nearby coefficients are likelier."""

import numpy as np
import pytest

from pipeline.confidence.logistic import (
    RIDGE,
    LogisticModel,
    choice_log_probabilities,
    fit_choice_model,
    fit_logistic,
    sigmoid,
)


def test_logistic_model_by_hand() -> None:
    model = LogisticModel(mean_F=(1.0,), scale_F=(2.0,), coefficient_F=(3.0,), intercept=-1.5)
    assert model.probabilities(np.array([[1.0], [2.0]])) == pytest.approx(
        [1 / (1 + np.exp(1.5)), 0.5]
    )


def test_sigmoid_does_not_overflow() -> None:
    assert sigmoid(np.array([-1e4, 0.0, 1e4])).tolist() == [0, 0.5, 1]


def test_fit_logistic_without_information_gives_share() -> None:
    """3 of 4 by weight: a feature without variance carries no information."""
    model = fit_logistic(np.ones((2, 1)), np.array([1.0, 0.0]), np.array([3.0, 1.0]))
    assert model.probabilities(np.ones((1, 1))) == pytest.approx([0.75], abs=1e-5)
    assert model.coefficient_F == (0,)


def test_fit_logistic_is_at_the_optimum() -> None:
    rng = np.random.default_rng(0)
    x_NF = rng.normal(size=(60, 2))
    yes_N = (rng.uniform(size=60) < sigmoid(2 * x_NF[:, 0] - 1)).astype(float)
    weight_N = rng.uniform(0.5, 2, 60)
    model = fit_logistic(x_NF, yes_N, weight_N)
    standard_NF = (x_NF - model.mean_F) / np.array(model.scale_F)

    def loss(beta: np.ndarray) -> float:
        z_N = beta[0] + standard_NF @ beta[1:]
        return float(
            (weight_N * (np.logaddexp(0, z_N) - yes_N * z_N)).sum()
            + RIDGE / 2 * (beta[1:] ** 2).sum()
        )

    beta = np.array([model.intercept, *model.coefficient_F])
    assert all(
        loss(beta) < loss(beta + step) for step in 1e-2 * np.concatenate([np.eye(3), -np.eye(3)])
    )


def test_fit_logistic_separable_examples_stay_finite() -> None:
    model = fit_logistic(np.array([[0.0], [1.0]]), np.array([0.0, 1.0]), np.ones(2))
    assert (
        0.05
        < model.probabilities(np.array([[0.0]]))[0]
        < 0.5
        < model.probabilities(np.array([[1.0]]))[0]
        < 0.95
    )


def test_choice_log_probabilities_by_hand() -> None:
    """Weights 2, 1 and 3 of six."""
    p_NC = np.exp(choice_log_probabilities(np.array([[np.log(2), 0.0, -np.inf]]), 1.0, np.log(3)))
    assert p_NC == pytest.approx(np.array([[2 / 6, 1 / 6, 0, 3 / 6]]))


def test_fit_choice_model_recovers_known_odds() -> None:
    rng = np.random.default_rng(0)
    x_NK = rng.uniform(0, 0.4, size=(4000, 5))
    p_NC = np.exp(choice_log_probabilities(x_NK, 12.0, 2.0))
    chosen_N = np.array([rng.choice(6, p=p_C) for p_C in p_NC])
    inverse_temperature, outside = fit_choice_model(x_NK, chosen_N, np.ones(4000))
    assert inverse_temperature == pytest.approx(12, rel=0.1)
    assert outside == pytest.approx(2, abs=0.2)


def test_choice_model_missing_candidates_have_probability_0() -> None:
    x_NK = np.array([[0.3, -np.inf], [0.1, -np.inf]] * 10)
    inverse_temperature, outside = fit_choice_model(x_NK, np.array([0, 2] * 10), np.ones(20))
    p_NC = np.exp(choice_log_probabilities(x_NK[:2], inverse_temperature, outside))
    assert p_NC[:, 1].tolist() == [0, 0]
    assert p_NC[0, 0] > 0.5 > p_NC[1, 0]
