"""Probabilities of examples by models that were fitted without them, and the threshold to answer
at.

NumPy only, no I/O. Shapes: N examples, F features.
"""

import hashlib

import numpy as np

from pipeline.confidence.logistic import fit_logistic
from pipeline.core.arrays import Doubles, Strings

FOLDS = 5
UNDECIDED = 0.5
"""The threshold where examples of one kind only leave nothing to choose it by, and the probability
of examples without others to fit on."""


def cross_validated_probabilities(
    x_NF: Doubles, yes_N: Doubles, weight_N: Doubles, locations_N: Strings
) -> Doubles:
    """Each example's probability (N,) by a model that was fitted without its location."""
    folds = {
        name: hashlib.sha256(name.encode()).digest()[0] % FOLDS
        for name in np.unique(locations_N).tolist()
    }
    fold_N = np.array([folds[name] for name in locations_N.tolist()])
    p_N = np.empty(len(x_NF))
    for fold in np.unique(fold_N):
        left_out_N = fold_N == fold
        if left_out_N.all():  # too few locations to fit without one
            p_N[left_out_N] = UNDECIDED
            continue
        model = fit_logistic(x_NF[~left_out_N], yes_N[~left_out_N], weight_N[~left_out_N])
        p_N[left_out_N] = model.probabilities(x_NF[left_out_N])
    return p_N


def youden_threshold(p_N: Doubles, yes_N: Doubles, weight_N: Doubles) -> float:
    """The lowest probability to answer at: there the share of right answers kept, less the share of
    wrong answers kept, is greatest (Youden 1950). Each share is of its own kind's total, so that
    neither kind is given up for being rare. UNDECIDED where a kind is missing."""
    order_N = np.argsort(-p_N, kind="stable")
    right_N, wrong_N = (weight_N * yes_N)[order_N], (weight_N * (1 - yes_N))[order_N]
    if not right_N.any() or not wrong_N.any():
        return UNDECIDED
    gain_N = np.cumsum(right_N) / right_N.sum() - np.cumsum(wrong_N) / wrong_N.sum()
    return float(p_N[order_N][int(np.argmax(gain_N))])


def wrong_share_threshold(
    p_N: Doubles, yes_N: Doubles, weight_N: Doubles, most_wrong: float
) -> float:
    """The probability to answer at so that of the answers given at most `most_wrong` is wrong, and
    as many right ones as possible are given: midway, in log-odds, between the last example that is
    answered and the first that is not. UNDECIDED where a kind is missing."""
    order_N = np.argsort(-p_N, kind="stable")
    given_N, wrong_N = weight_N[order_N], (weight_N * (1 - yes_N))[order_N]
    if not wrong_N.any() or wrong_N.sum() == given_N.sum():
        return UNDECIDED
    allowed_N = np.cumsum(wrong_N) <= most_wrong * np.cumsum(given_N)
    # Equal probabilities are answered together.
    last_N = np.append(np.diff(p_N[order_N]) != 0, True)
    cuts = np.flatnonzero(allowed_N & last_N)
    if len(cuts) == 0:  # the surest of all are wrong too often
        return 1.0
    cut = int(cuts[-1])
    if cut == len(p_N) - 1:  # all are answered
        return float(p_N.min())
    around = p_N[order_N][cut : cut + 2].clip(1e-9, 1 - 1e-9)
    log_odds = float(np.log(around / (1 - around)).mean())
    return float(1 / (1 + np.exp(-log_odds)))
