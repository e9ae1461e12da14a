"""The chance that a single shot is right, from a score of the likelihood: how much of its mass is in the best mode.

A score is no probability before it has been compared with outcomes. Two parameters do that: a logistic on the score's
log odds (Platt, "Probabilistic Outputs for Support Vector Machines", 1999, with his smoothed targets).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize
from scipy.special import expit, logit

from fusion.errors import SkyfixError
from fusion.likelihood import PoseLikelihood

_LEAST_SCORE = 1e-6


def peak_mass(likelihood: PoseLikelihood) -> float:
    """The share of a likelihood's mass in its best mode (within 3 m and 10 degrees, or three standard deviations)."""
    return float(likelihood.modes(1).weights[0])


def probability(score: ArrayLike, slope: float, intercept: float) -> NDArray[np.float64]:
    """The chance of being right at scores in [0, 1]; slope 1 and intercept 0 give the score back."""
    return np.asarray(expit(slope * _log_odds(score) + intercept), dtype=np.float64)


def fit_confidence(scores: ArrayLike, correct: ArrayLike) -> tuple[float, float]:
    """Slope and intercept under which the outcomes are likeliest.

    Parameters
    ----------
    scores
        (N,) in [0, 1].
    correct
        (N,) bool: whether the single shot was right.

    Raises
    ------
    SkyfixError
        If there are none, their numbers differ or a score is out of range.
    """
    log_odds, right = _log_odds(scores), np.asarray(correct, dtype=np.bool_)
    if len(log_odds) == 0 or log_odds.shape != right.shape:
        raise SkyfixError(f"confidence: expected as many scores as outcomes, got {log_odds.shape} and {right.shape}")
    hits, misses = int(right.sum()), int((~right).sum())
    targets = np.where(right, (hits + 1) / (hits + 2), 1 / (misses + 2))

    def nll(parameters: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        z = parameters[0] * log_odds + parameters[1]
        excess = expit(z) - targets
        value = np.mean(np.logaddexp(0.0, z) - targets * z)
        return float(value), np.array([np.mean(excess * log_odds), np.mean(excess)])

    found = minimize(nll, np.array([1.0, 0.0]), jac=True, method="L-BFGS-B", bounds=[(0.0, 20.0), (-20.0, 20.0)])
    return float(found.x[0]), float(found.x[1])


def _log_odds(scores: ArrayLike) -> NDArray[np.float64]:
    values = np.atleast_1d(np.asarray(scores, dtype=np.float64))
    if not ((values >= 0.0) & (values <= 1.0)).all():
        raise SkyfixError(f"confidence: expected scores in [0, 1], got {values.min():g} to {values.max():g}")
    return np.asarray(logit(np.clip(values, _LEAST_SCORE, 1.0 - _LEAST_SCORE)), dtype=np.float64)
