"""Positive definite covariances, and between the axes of the map and those of the body.

GTSAM speaks in body-frame tangent vectors: an error on a pose with yaw t is ``R(t)^T`` times that on the axes of the
map, to first order.
"""

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from fusion import se2
from fusion.arrays import FloatArray

_LEAST_VARIANCE = 1e-15


def positive_definite(covariances: FloatArray) -> FloatArray:
    """Symmetric with eigenvalues of at least the least variance; (..., 3, 3)."""
    symmetric = 0.5 * (covariances + covariances.swapaxes(-1, -2))
    values, vectors = np.linalg.eigh(symmetric)
    if values.min(initial=np.inf) >= _LEAST_VARIANCE:
        return symmetric
    return (vectors * np.maximum(values, _LEAST_VARIANCE)[..., None, :]) @ vectors.swapaxes(-1, -2)


def turned(covariances: FloatArray, yaw: ArrayLike) -> FloatArray:
    """Covariances (..., 3, 3) on axes that are turned by `yaw` (...)."""
    turn = se2.rotation(yaw)
    return turn @ covariances @ turn.swapaxes(-1, -2)


def noises_of(covariances: FloatArray, yaw: FloatArray) -> list[gtsam.noiseModel.Gaussian]:
    """Noises of factors at poses with these yaws (M,), from covariances (M, 3, 3) on the axes of the frames above."""
    create = gtsam.noiseModel.Gaussian.Covariance
    return [create(covariance, False) for covariance in positive_definite(turned(covariances, -yaw))]
