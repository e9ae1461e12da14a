"""Resampling schemes: from N weighted particles to n equally weighted ones.

Every scheme is unbiased: the expected number of copies of particle i is ``n * weight_i``. They differ in the variance
of that number. Indices come out sorted.

Source: Douc, Cappe, Moulines, "Comparison of resampling schemes for particle filtering", ISPA 2005.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from fusion.arrays import FloatArray, IntArray, checked
from fusion.errors import SkyfixError

Resampler = Callable[[ArrayLike, int, np.random.Generator], IntArray]


def _cumulative(weights: ArrayLike, n: int) -> FloatArray:
    """Cumulative weights scaled to end at 1, after checking them."""
    weights = checked("weights", weights, ("N",))
    if n < 0:
        raise SkyfixError(f"resampling: expected n >= 0, got {n}")
    if len(weights) == 0 or weights.min() < 0.0 or not weights.sum() > 0.0:
        raise SkyfixError(f"weights: expected non-negative with a positive sum, got a sum of {weights.sum():g}")
    cumulative = np.cumsum(weights)
    return cumulative / cumulative[-1]


def _pick(cumulative: FloatArray, points: FloatArray) -> IntArray:
    """Index of the particle in whose share of [0, 1) each sorted point lies; never one of weight 0."""
    return np.searchsorted(cumulative, np.minimum(points, np.nextafter(1.0, 0.0)), side="right").astype(np.int64)


def systematic(weights: ArrayLike, n: int, rng: np.random.Generator) -> IntArray:
    """One random offset, then every n-th part of the total weight; indices (n,).

    The copies of particle i number ``n * weight_i`` rounded up or down.
    """
    return _pick(_cumulative(weights, n), (np.arange(n) + rng.random()) / max(n, 1))


def stratified(weights: ArrayLike, n: int, rng: np.random.Generator) -> IntArray:
    """One random point in every n-th part of the total weight; indices (n,)."""
    return _pick(_cumulative(weights, n), (np.arange(n) + rng.random(n)) / max(n, 1))


def multinomial(weights: ArrayLike, n: int, rng: np.random.Generator) -> IntArray:
    """Independent draws; indices (n,)."""
    return _pick(_cumulative(weights, n), np.sort(rng.random(n)))


def residual(weights: ArrayLike, n: int, rng: np.random.Generator) -> IntArray:
    """The whole part of ``n * weight_i`` copies for certain, the rest by independent draws; indices (n,)."""
    cumulative = _cumulative(weights, n)
    expected = n * np.diff(cumulative, prepend=0.0)
    copies = np.floor(expected).astype(np.int64)
    certain = np.repeat(np.arange(len(copies)), copies)
    missing = n - len(certain)
    if missing <= 0:
        return certain[:n]
    return np.sort(np.concatenate([certain, multinomial(expected - copies, missing, rng)]))


RESAMPLERS: dict[str, Resampler] = {
    "systematic": systematic,
    "stratified": stratified,
    "residual": residual,
    "multinomial": multinomial,
}


def effective_sample_size(log_weights: ArrayLike) -> float:
    """``(sum w)^2 / sum w^2`` of log weights (N,), which need not be normalised; between 1 and N."""
    log_weights = np.asarray(log_weights, dtype=np.float64)
    return float(np.exp(2.0 * logsumexp(log_weights) - logsumexp(2.0 * log_weights)))
