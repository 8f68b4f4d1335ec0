"""The two models of chance: what they say, and that no nearby coefficients explain the examples
better.
"""

import numpy as np
import pytest

from pipeline.locate.logistic import (
    RIDGE,
    LogisticModel,
    choice_log_probabilities,
    fit_choice_model,
    fit_logistic,
    sigmoid,
)


def test_a_model_says_what_its_formula_says() -> None:
    model = LogisticModel(mean_F=(1.0,), scale_F=(2.0,), coefficient_F=(3.0,), intercept=-1.5)
    assert model.probabilities(np.array([[1.0], [2.0]])) == pytest.approx(
        [1 / (1 + np.exp(1.5)), 0.5]
    )


def test_the_sigmoid_does_not_overflow() -> None:
    assert sigmoid(np.array([-1e4, 0.0, 1e4])).tolist() == [0, 0.5, 1]


def test_without_information_the_probability_is_the_share() -> None:
    """3 of 4 by weight: a feature without spread says nothing."""
    model = fit_logistic(np.ones((2, 1)), np.array([1.0, 0.0]), np.array([3.0, 1.0]))
    assert model.probabilities(np.ones((1, 1))) == pytest.approx([0.75], abs=1e-5)
    assert model.coefficient_F == (0,)


def test_no_step_from_the_fitted_coefficients_is_likelier() -> None:
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


def test_examples_that_part_perfectly_leave_coefficients_finite() -> None:
    model = fit_logistic(np.array([[0.0], [1.0]]), np.array([0.0, 1.0]), np.ones(2))
    assert (
        0.05
        < model.probabilities(np.array([[0.0]]))[0]
        < 0.5
        < model.probabilities(np.array([[1.0]]))[0]
        < 0.95
    )


def test_choices_are_a_softmax_with_none_of_them_last() -> None:
    """Weights 2, 1 and 3 of six."""
    said = np.exp(choice_log_probabilities(np.array([[np.log(2), 0.0, -np.inf]]), 1.0, np.log(3)))
    assert said == pytest.approx(np.array([[2 / 6, 1 / 6, 0, 3 / 6]]))


def test_choices_made_by_known_odds_give_the_odds_back() -> None:
    rng = np.random.default_rng(0)
    x_NK = rng.uniform(0, 0.4, size=(4000, 5))
    p_NC = np.exp(choice_log_probabilities(x_NK, 12.0, 2.0))
    chosen_N = np.array([rng.choice(6, p=p_C) for p_C in p_NC])
    inverse_temperature, outside = fit_choice_model(x_NK, chosen_N, np.ones(4000))
    assert inverse_temperature == pytest.approx(12, rel=0.1)
    assert outside == pytest.approx(2, abs=0.2)


def test_candidates_that_are_not_there_are_never_chosen() -> None:
    x_NK = np.array([[0.3, -np.inf], [0.1, -np.inf]] * 10)
    inverse_temperature, outside = fit_choice_model(x_NK, np.array([0, 2] * 10), np.ones(20))
    said = np.exp(choice_log_probabilities(x_NK[:2], inverse_temperature, outside))
    assert said[:, 1].tolist() == [0, 0]
    assert said[0, 0] > 0.5 > said[1, 0]
