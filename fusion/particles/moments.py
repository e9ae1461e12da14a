"""Mean and covariance of a cloud, and roots of covariances, in plain numbers: small arrays cost more than the sums."""

from math import pi, remainder, sqrt
from typing import NamedTuple

import numpy as np

from fusion.arrays import FloatArray
from fusion.particles.clusters import VARIANCE_FLOOR

_ROUNDING = 1e-14
_TURN = 2.0 * pi
_FLOOR_M2, _FLOOR_RAD2 = float(VARIANCE_FLOOR[0, 0]), float(VARIANCE_FLOOR[2, 2])


class Moments(NamedTuple):
    """Sums over a weighted cloud.

    Parameters
    ----------
    effective_sample_size : float
        ``(sum w)^2 / sum w^2``.
    mean : tuple of 3 floats
        x, y relative to the anchor, yaw wrapped and circular.
    covariance : list of 3 lists of 3 floats
        About the mean, without a correction for the sample's size.
    """

    effective_sample_size: float
    mean: tuple[float, float, float]
    covariance: list[list[float]]


def lower_root(covariance: list[list[float]]) -> list[float]:
    """Lower triangular L, row by row (9,), with ``L L^T = covariance``; positive semidefinite will do."""
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = covariance
    a = sqrt(xx) if xx > 0.0 else 0.0
    b, c = (xy / a, xt / a) if a > 0.0 else (0.0, 0.0)
    rest = yy - b * b
    d = sqrt(rest) if rest > _ROUNDING * yy else 0.0
    e = (yt - b * c) / d if d > 0.0 else 0.0
    rest = tt - c * c - e * e
    return [a, 0.0, 0.0, b, d, 0.0, c, e, sqrt(rest) if rest > _ROUNDING * tt else 0.0]


def motion_root(covariance: list[list[float]]) -> list[float]:
    """As `lower_root`, for noise of a motion whose heading is wrapped: at most a turn of standard deviation.

    A normal heading of one turn is uniform on the circle but for ``2 exp(-2 pi^2) = 5e-9`` of its density, less than
    float32 resolves, and a wider one is the same. Correlations stay as they are.
    """
    root, deviation = lower_root(covariance), sqrt(max(covariance[2][2], 0.0))
    if deviation > _TURN:
        root[6:] = [value * (_TURN / deviation) for value in root[6:]]
    return root


def positive_definite(covariance: list[list[float]], factor: float) -> FloatArray:
    """A covariance (3, 3) times a factor, plus 1 mm and 0.1 mrad squared; rounding below zero is taken away."""
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = covariance
    xy, xt, yt = xy * factor, xt * factor, yt * factor
    rows = [
        [xx * factor + _FLOOR_M2, xy, xt],
        [xy, yy * factor + _FLOOR_M2, yt],
        [xt, yt, tt * factor + _FLOOR_RAD2],
    ]
    root, result = lower_root(rows), np.array(rows)
    if root[0] > 0.0 and root[4] > 0.0 and root[8] > 0.0:
        return result
    values, vectors = np.linalg.eigh(result)
    return (vectors * np.maximum(values, _FLOOR_RAD2)) @ vectors.T


def wrapped(angle: float) -> float:
    """An angle in [-pi, pi)."""
    if -pi <= angle < pi:
        return angle
    turned = remainder(angle, 2.0 * pi)
    return turned if turned < pi else -pi
