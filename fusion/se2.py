"""Batched rigid motions of the plane, SE(2), on arrays whose last axis is ``[x, y, yaw]`` in metres and radians.

A pose ``a_from_b`` maps points of frame b into frame a. Yaw is counter-clockwise, zero along +x, wrapped to [-pi, pi)
(REP-103). Twists are ``[v_x, v_y, omega]`` in the body frame. Leading axes broadcast as in numpy.

Source: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", arXiv 1812.01537, appendix A.
The coefficients of V and its inverse are written with half angles, which needs no series at zero and no special case
at +-pi.
"""

import numpy as np
from numpy.typing import ArrayLike

from fusion.arrays import FloatArray, checked
from fusion.errors import SkyfixError

TWO_PI = 2.0 * np.pi


def wrap(angle: ArrayLike) -> FloatArray:
    """Wrap angles to [-pi, pi); angles already inside are returned bit for bit."""
    angle = np.asarray(angle, dtype=np.float64)
    wrapped = angle - TWO_PI * np.floor((angle + np.pi) / TWO_PI)
    wrapped = np.where((wrapped >= np.pi) | (wrapped < -np.pi), -np.pi, wrapped)  # rounding at the seam
    return np.where((angle >= -np.pi) & (angle < np.pi), angle, wrapped)


def _pose(x: FloatArray, y: FloatArray, yaw: FloatArray) -> FloatArray:
    return np.stack(np.broadcast_arrays(x, y, yaw), axis=-1)


def _rotate(yaw: FloatArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    cos, sin = np.cos(yaw), np.sin(yaw)
    return cos * x - sin * y, sin * x + cos * y


def compose(a: FloatArray, b: FloatArray) -> FloatArray:
    """``a * b``: with ``a = map_from_base`` and ``b = base_from_sensor`` this is ``map_from_sensor``."""
    x, y = _rotate(a[..., 2], b[..., 0], b[..., 1])
    return _pose(a[..., 0] + x, a[..., 1] + y, wrap(a[..., 2] + b[..., 2]))


def inverse(pose: FloatArray) -> FloatArray:
    """``b_from_a`` of ``a_from_b``."""
    x, y = _rotate(-pose[..., 2], -pose[..., 0], -pose[..., 1])
    return _pose(x, y, wrap(-pose[..., 2]))


def between(a: FloatArray, b: FloatArray) -> FloatArray:
    """``inverse(a) * b``: pose b seen from pose a."""
    x, y = _rotate(-a[..., 2], b[..., 0] - a[..., 0], b[..., 1] - a[..., 1])
    return _pose(x, y, wrap(b[..., 2] - a[..., 2]))


def exp(twist: FloatArray) -> FloatArray:
    """Pose reached by moving with the constant body twist ``[v_x, v_y, omega]`` for one unit of time."""
    omega = twist[..., 2]
    a = np.sinc(omega / np.pi)  # sin(w) / w
    b = 0.5 * omega * np.sinc(0.5 * omega / np.pi) ** 2  # (1 - cos(w)) / w
    x = a * twist[..., 0] - b * twist[..., 1]
    y = b * twist[..., 0] + a * twist[..., 1]
    return _pose(x, y, wrap(omega))


def log(pose: FloatArray) -> FloatArray:
    """Constant body twist, |omega| <= pi, that reaches `pose` in one unit of time; the inverse of :func:`exp`."""
    omega = wrap(pose[..., 2])
    half = 0.5 * omega
    a = np.cos(half) / np.sinc(half / np.pi)  # (w / 2) cot(w / 2)
    x = a * pose[..., 0] + half * pose[..., 1]
    y = -half * pose[..., 0] + a * pose[..., 1]
    return _pose(x, y, omega)


def adjoint(pose: FloatArray) -> FloatArray:
    """Adjoint matrices (..., 3, 3): ``pose * exp(t) == exp(adjoint(pose) @ t) * pose``."""
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    matrix = np.zeros((*pose.shape[:-1], 3, 3))
    matrix[..., 0, 0] = matrix[..., 1, 1] = cos
    matrix[..., 0, 1] = -sin
    matrix[..., 1, 0] = sin
    matrix[..., 0, 2] = pose[..., 1]
    matrix[..., 1, 2] = -pose[..., 0]
    matrix[..., 2, 2] = 1.0
    return matrix


def rotation(yaw: ArrayLike) -> FloatArray:
    """Matrices (..., 3, 3) that turn body-frame ``[x, y, yaw]`` deviations by `yaw` into the frame above."""
    yaw = np.asarray(yaw, dtype=np.float64)
    return adjoint(_pose(np.zeros_like(yaw), np.zeros_like(yaw), yaw))


def transform_points(pose: FloatArray, points: FloatArray) -> FloatArray:
    """Map points (..., 2) of frame b into frame a by ``pose = a_from_b`` (..., 3); leading axes broadcast."""
    x, y = _rotate(pose[..., 2], points[..., 0], points[..., 1])
    return np.stack(np.broadcast_arrays(pose[..., 0] + x, pose[..., 1] + y), axis=-1)


def circular_mean(angles: ArrayLike, weights: ArrayLike | None = None) -> float:
    """Direction of the (weighted) resultant of `angles` (N,), in [-pi, pi); 0 when the resultant vanishes exactly.

    Parameters
    ----------
    angles : (N,) array_like
        Radians, wrapped or not.
    weights : (N,) array_like, optional
        Non-negative, any scale; equal weights when left out.
    """
    angles = checked("angles", angles, ("N",))
    factors = np.ones_like(angles) if weights is None else checked("weights", weights, (len(angles),))
    return float(wrap(np.arctan2(factors @ np.sin(angles), factors @ np.cos(angles))))


def weighted_mean_and_covariance(poses: ArrayLike, weights: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Mean pose and covariance of a weighted cloud, in the frame of the poses.

    Parameters
    ----------
    poses : (N, 3) array_like
        ``[x, y, yaw]``.
    weights : (N,) array_like
        Non-negative, any scale.

    Returns
    -------
    mean : (3,) ndarray
        Arithmetic mean of x and y, circular mean of yaw.
    covariance : (3, 3) ndarray
        Second moments about the mean, the yaw residual wrapped; positive semidefinite.

    Raises
    ------
    SkyfixError
        When the weights are negative or sum to zero, or a value is not finite.
    """
    poses = checked("poses", poses, ("N", 3))
    weights = checked("weights", weights, (len(poses),))
    total = weights.sum()
    if weights.min(initial=0.0) < 0.0 or not total > 0.0:
        raise SkyfixError(f"weights: expected non-negative with a positive sum, got a sum of {total:g}")
    share = weights / total
    mean = share @ poses
    mean[2] = circular_mean(poses[:, 2], share)
    residual = poses - mean
    residual[:, 2] = wrap(residual[:, 2])
    return mean, (residual * share[:, None]).T @ residual
