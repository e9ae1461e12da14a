"""Bridges: the poses between two known ones, given the odometry in between.

Given both ends, the errors e_k of the K increments between them are Gaussian, conditioned on a sum: to first order the
end moves by ``sum J_k e_k``, with J_k the Jacobians that `odometry.accumulate` propagates covariances with. A draw of
the conditional is a free draw, corrected by what it misses the end by (Hoffman and Ribak, "Constrained realizations
of Gaussian fields", 1991),

    e_k <- e_k + Q_k J_k^T S^-1 (miss),        S = sum J_k Q_k J_k^T

and as the motion is not quite linear in the errors, the correction is made three times.
"""

from collections.abc import Sequence

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, checked
from fusion.odometry import OdometryIncrement
from fusion.particles.regularisation import matrix_root

_CORRECTIONS = 3
_LEAST_VARIANCE = np.diag([1e-10, 1e-10, 1e-12])  # keeps S invertible when an odometry claims to be perfect


def bridge(
    start: FloatArray, end: FloatArray, increments: Sequence[OdometryIncrement], rng: np.random.Generator
) -> FloatArray:
    """Draw the poses at the end of every increment but the last.

    Parameters
    ----------
    start, end : (M, 3) float64
        Poses before the first and after the last increment, a pair for each of M paths.
    increments : sequence of K OdometryIncrement
        Motions in between.
    rng : numpy Generator
        Source of randomness.

    Returns
    -------
    (M, K - 1, 3) float64
        One draw for each path, jointly over the K - 1 stamps.
    """
    start = checked("start", start, ("M", 3))
    end = checked("end", end, (len(start), 3))
    count = len(increments)
    if count == 1:
        return np.empty((len(start), 0, 3))
    deltas = np.array([increment.delta for increment in increments])
    covariances = np.array([increment.covariance for increment in increments]) + _LEAST_VARIANCE
    jacobians = _jacobians(deltas)
    gains = covariances @ jacobians.swapaxes(1, 2)
    gains = gains @ np.linalg.inv((jacobians @ gains).sum(axis=0))
    noise = rng.standard_normal((len(start), count, 3))
    errors = np.einsum("kij,mkj->mki", matrix_root(covariances), noise)
    for _ in range(_CORRECTIONS):
        reached = _walk(start, deltas + errors)[:, -1]
        miss = end - reached
        miss[:, 2] = se2.wrap(miss[:, 2])
        seen = np.einsum("mij,mj->mi", se2.rotation(-start[:, 2]), miss)
        errors = errors + np.einsum("kij,mj->mki", gains, seen)
    return _walk(start, deltas + errors)[:, :-1]


def _walk(start: FloatArray, steps: FloatArray) -> FloatArray:
    """Poses (M, K, 3) after each of the steps (M, K, 3)."""
    poses = np.empty_like(steps)
    pose = start
    for k in range(steps.shape[1]):
        pose = se2.compose(pose, steps[:, k])
        poses[:, k] = pose
    return poses


def _jacobians(deltas: FloatArray) -> FloatArray:
    """Of the last pose by each increment's error, (K, 3, 3), on the axes of the start."""
    poses = _walk(np.zeros((1, 3)), deltas[None])[0]
    before = np.concatenate([np.zeros((1, 3)), poses[:-1]])
    jacobians = se2.rotation(before[:, 2])
    lever = poses[-1, :2] - poses[:, :2]  # a turn at the end of a step swings all that follows
    jacobians[:, 0, 2] = -lever[:, 1]
    jacobians[:, 1, 2] = lever[:, 0]
    return jacobians
