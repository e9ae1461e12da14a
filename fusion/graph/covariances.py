"""Positive definite covariances, and between the axes of the map and those of the body.

GTSAM speaks in body-frame tangent vectors: an error on a pose with yaw t is ``R(t)^T`` times that on the axes of the
map, to first order.
"""

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion import se2
from fusion.arrays import FloatArray

_LEAST_VARIANCE = 1e-15


def positive_definite(covariances: FloatArray) -> FloatArray:
    """Symmetric with eigenvalues of at least the least variance; (..., 3, 3)."""
    return raised(covariances, _LEAST_VARIANCE)


def raised(matrices: FloatArray, least: float) -> FloatArray:
    """The symmetric parts (..., 3, 3) with all eigenvalues raised to at least `least`; most need no raising."""
    symmetric = np.asarray(0.5 * (matrices + matrices.swapaxes(-1, -2)))
    low = ~_all_above(symmetric, least)
    if low.any():
        values, vectors = np.linalg.eigh(symmetric[low])
        symmetric[low] = (vectors * np.maximum(values, least)[..., None, :]) @ vectors.swapaxes(-1, -2)
    return symmetric


def _all_above(symmetric: FloatArray, least: float) -> NDArray[np.bool_]:
    """Whether (...) all eigenvalues are above a bound: the leading minors are positive (Sylvester)."""
    a, b, c = (symmetric[..., i, i] - least for i in range(3))
    d, e, f = symmetric[..., 1, 0], symmetric[..., 2, 0], symmetric[..., 2, 1]
    second = a * b - d * d
    return np.asarray((a > 0.0) & (second > 0.0) & (c * second + 2.0 * d * e * f - b * e * e - a * f * f > 0.0))


def turned(covariances: FloatArray, yaw: ArrayLike) -> FloatArray:
    """Covariances (..., 3, 3) on axes that are turned by `yaw` (...)."""
    turn = se2.rotation(yaw)
    return turn @ covariances @ turn.swapaxes(-1, -2)


def noises_of(covariances: FloatArray, yaw: FloatArray) -> list[gtsam.noiseModel.Gaussian]:
    """Noises of factors at poses with these yaws (M,), from covariances (M, 3, 3) on the axes of the frames above."""
    create = gtsam.noiseModel.Gaussian.Covariance
    return [create(covariance, False) for covariance in positive_definite(turned(covariances, -yaw))]
