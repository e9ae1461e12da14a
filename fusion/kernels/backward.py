"""Backward simulation from one cloud to the one before, compiled.

A path that is at y at the later stamp was at particle i before with a probability in proportion to

    w_i exp(-|W (i^-1 y - d)|^2 / 2)          W^T W = Q^-1, d and Q the motion and its covariance

so propose i by its weight and accept with the exponential, which is the transition density over its maximum
(Douc, Garivier, Moulines, Olsson 2011, algorithm 2); after too many rejections, draw from the exact probabilities
(Godsill, Doucet, West 2004, algorithm 1). Both give the same distribution.

`numpy.random.Generator` gives the same numbers here as in numpy.
"""

import math

import numba
import numpy as np

from fusion.arrays import FloatArray, IntArray

_NEGLIGIBLE = 45.0  # nats below the likeliest particle: exp(-45) is 3e-20


@numba.njit(cache=True, inline="always")
def _half_square(
    particle: FloatArray, cos: float, sin: float, later: FloatArray, delta: FloatArray, whiten: FloatArray
) -> float:
    """Half the squared Mahalanobis distance of the motion from a particle to a later pose."""
    dx, dy = later[0] - particle[0], later[1] - particle[1]
    x = cos * dx + sin * dy - delta[0]
    y = -sin * dx + cos * dy - delta[1]
    turned = later[2] - particle[2] - delta[2]
    turned -= 2.0 * math.pi * math.floor((turned + math.pi) / (2.0 * math.pi))
    a = whiten[0, 0] * x
    b = whiten[1, 0] * x + whiten[1, 1] * y
    c = whiten[2, 0] * x + whiten[2, 1] * y + whiten[2, 2] * turned
    return 0.5 * (a * a + b * b + c * c)


@numba.njit(cache=True, nogil=True)
def motion_density(
    particles: FloatArray, weights: FloatArray, later: FloatArray, delta: FloatArray, whiten: FloatArray
) -> FloatArray:
    """Density (M,), per m^2 rad, that particles of these weights and a motion give to each of `later` (M, 3)."""
    cos, sin = np.cos(particles[:, 2]), np.sin(particles[:, 2])
    scale = whiten[0, 0] * whiten[1, 1] * whiten[2, 2] / (2.0 * math.pi) ** 1.5
    density = np.zeros(later.shape[0])
    for m in range(later.shape[0]):
        for i in range(particles.shape[0]):
            half = _half_square(particles[i], cos[i], sin[i], later[m], delta, whiten)
            density[m] += weights[i] * math.exp(-half) if half < _NEGLIGIBLE else 0.0
        density[m] *= scale
    return density


@numba.njit(cache=True, nogil=True)
def step_back(
    particles: FloatArray,
    weights: FloatArray,
    later: FloatArray,
    delta: FloatArray,
    whiten: FloatArray,
    max_rejections: int,
    rng: np.random.Generator,
) -> tuple[IntArray, int]:
    """Index (M,) of the particle before each of `later` (M, 3), and how many of them rejection sampling found.

    `whiten` (3, 3) is lower triangular. Weights (N,) sum to 1.
    """
    count, paths = particles.shape[0], later.shape[0]
    cumulative = np.cumsum(weights)
    cos, sin = np.cos(particles[:, 2]), np.sin(particles[:, 2])
    log_weights = np.empty(count)
    for i in range(count):
        log_weights[i] = math.log(weights[i]) if weights[i] > 0.0 else -math.inf
    score = np.empty(count)
    chosen = np.empty(paths, dtype=np.int64)
    found = 0
    for m in range(paths):
        accepted = False
        for _ in range(max_rejections):
            i = min(np.searchsorted(cumulative, rng.random() * cumulative[-1], side="right"), count - 1)
            if rng.random() < math.exp(-_half_square(particles[i], cos[i], sin[i], later[m], delta, whiten)):
                chosen[m], accepted = i, True
                found += 1
                break
        if accepted:
            continue
        best = -math.inf
        for i in range(count):
            score[i] = log_weights[i] - _half_square(particles[i], cos[i], sin[i], later[m], delta, whiten)
            best = max(best, score[i])
        total = 0.0
        for i in range(count):
            total += math.exp(score[i] - best) if score[i] - best > -_NEGLIGIBLE else 0.0
            score[i] = total
        chosen[m] = min(np.searchsorted(score, rng.random() * total, side="right"), count - 1)
    return chosen, found
