"""Two small probability models, fitted by Newton's method: logistic regression (yes or no) and a
conditional logit (which of several candidates, or none).

NumPy only, no I/O. Shapes: N examples, F features, K candidates, C = K + 1 choices, G = F + 1
coefficients with the intercept.
"""

from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Doubles, Ints

NEWTON_STEPS = 50
"The iteration converges in about ten steps; both losses are convex."

RIDGE = 1.0
"""Penalty of half the squared standardised coefficients, added to the summed loss of all examples:
the weight of about one example that carries no information. It keeps coefficients finite where a
feature separates the examples perfectly."""


@dataclass(frozen=True, kw_only=True)
class LogisticModel:
    """P(yes | x) = sigmoid(intercept + sum of coefficient * (x - mean) / scale)."""

    mean_F: tuple[float, ...]
    scale_F: tuple[float, ...]
    coefficient_F: tuple[float, ...]
    intercept: float

    def probabilities(self, x_NF: Doubles) -> Doubles:
        """P(yes) of each example (N,)."""
        standard_NF = (x_NF - np.array(self.mean_F)) / np.array(self.scale_F)
        return sigmoid(self.intercept + standard_NF @ np.array(self.coefficient_F))


def sigmoid(x: Doubles) -> Doubles:
    """1 / (1 + exp(-x)), without overflow."""
    return np.asarray(np.exp(-np.logaddexp(0, -x)))


def fit_logistic(x_NF: Doubles, yes_N: Doubles, weight_N: Doubles) -> LogisticModel:
    """The model with the greatest penalised likelihood of these weighted examples.

    A feature without variance gets the coefficient 0.
    """
    mean_F = np.average(x_NF, axis=0, weights=weight_N)
    scale_F = np.sqrt(np.average((x_NF - mean_F) ** 2, axis=0, weights=weight_N))
    scale_F = np.where(scale_F > 1e-12, scale_F, 1.0)
    design_NG = np.column_stack([np.ones(len(x_NF)), (x_NF - mean_F) / scale_F])
    ridge_G = np.concatenate([[1e-6], np.full(x_NF.shape[1], RIDGE)])  # nearly none: the intercept
    beta_G = np.zeros(design_NG.shape[1])
    for _ in range(NEWTON_STEPS):
        p_N = sigmoid(design_NG @ beta_G)
        gradient_G = design_NG.T @ (weight_N * (p_N - yes_N)) + ridge_G * beta_G
        weighted_GN = design_NG.T * (weight_N * p_N * (1 - p_N))
        curvature_GG = weighted_GN @ design_NG + np.diag(ridge_G)
        step_G = np.linalg.solve(curvature_GG, gradient_G)
        beta_G -= step_G
        if np.abs(step_G).max() < 1e-9:
            break
    return LogisticModel(
        mean_F=tuple(mean_F.tolist()),
        scale_F=tuple(scale_F.tolist()),
        coefficient_F=tuple(beta_G[1:].tolist()),
        intercept=float(beta_G[0]),
    )


def choice_log_probabilities(
    x_NK: Doubles, inverse_temperature: float, none_log_odds: float
) -> Doubles:
    """Log-probabilities (N, C) of each candidate, and last of none of them: the softmax of
    inverse_temperature * x and of `none_log_odds`.

    -inf in x marks a candidate that does not exist.
    """
    logits_NC = np.column_stack([inverse_temperature * x_NK, np.full(len(x_NK), none_log_odds)])
    return np.asarray(logits_NC - np.logaddexp.reduce(logits_NC, axis=1, keepdims=True))


def fit_choice_model(x_NK: Doubles, chosen_N: Ints, weight_N: Doubles) -> tuple[float, float]:
    """(inverse_temperature, none_log_odds) under which the choices made (K: none) are likeliest; a
    conditional logit (McFadden 1974)."""
    beta_2 = np.zeros(2)
    finite_NK = np.isfinite(x_NK)
    feature_NC2 = np.zeros((len(x_NK), x_NK.shape[1] + 1, 2))
    feature_NC2[:, :-1, 0] = np.where(finite_NK, x_NK, 0)
    feature_NC2[:, -1, 1] = 1
    made_N2 = feature_NC2[np.arange(len(x_NK)), chosen_N]
    for _ in range(NEWTON_STEPS):
        log_p_NC = choice_log_probabilities(x_NK, max(float(beta_2[0]), 1e-6), float(beta_2[1]))
        p_NC = np.exp(log_p_NC)
        mean_N2 = np.einsum("nc,ncf->nf", p_NC, feature_NC2)
        gradient_2 = (weight_N[:, None] * (mean_N2 - made_N2)).sum(axis=0) + 1e-3 * beta_2
        centred_NC2 = feature_NC2 - mean_N2[:, None]
        curvature_22 = np.einsum("n,nc,ncf,ncg->fg", weight_N, p_NC, centred_NC2, centred_NC2)
        step_2 = np.linalg.solve(curvature_22 + 1e-3 * np.eye(2), gradient_2)
        scale_2 = np.array([x_NK[finite_NK].std() + 1e-12, 1])
        beta_2 -= step_2 * min(1.0, 5.0 / np.abs(step_2 * scale_2).max())
        if np.abs(step_2).max() < 1e-9:
            break
    return max(float(beta_2[0]), 0.0), float(beta_2[1])
