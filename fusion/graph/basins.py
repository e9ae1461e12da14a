"""What part of a likelihood belongs to one of several hypotheses of where the vehicle is."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray
from fusion.graph.patch import LikelihoodPatch, Neighbourhood

_REACH = 6.0  # standard deviations around a prediction within which a likelihood is kept
_MARGIN_M, _MARGIN_RAD = 6.0, 0.35  # and beyond, for a prediction that was wrong

Gaussian = tuple[FloatArray, FloatArray]
"""Mean (3,) and covariance (3, 3) of a pose, on the axes of the map."""


def around(pose: FloatArray, covariance: FloatArray) -> Neighbourhood:
    """Where a likelihood can matter to a pose (3,) with a covariance (3, 3)."""
    sigma = np.sqrt(np.diagonal(covariance))
    half_heading = min(np.pi, _REACH * float(sigma[2]) + _MARGIN_RAD)
    return Neighbourhood(pose, _REACH * float(sigma[:2].max()) + _MARGIN_M, half_heading)


def distance(a: Gaussian, b: Gaussian) -> float:
    """Mahalanobis distance of two means under the sum of their covariances."""
    off = a[0] - b[0]
    off[2] = se2.wrap(off[2])
    return float(np.sqrt(off @ np.linalg.solve(a[1] + b[1], off)))


def own_part(patch: LikelihoodPatch, own: Gaussian, others: Sequence[Gaussian]) -> LikelihoodPatch:
    """A patch with the cells at its floor that one of the others predicts better."""
    if not others:
        return patch
    x, y = patch.grid.centres()
    bins = patch.log_prob.shape[2]
    yaw = (patch.first_bin + np.arange(bins)) * (se2.TWO_PI / patch.bin_count)
    poses = np.stack(np.meshgrid(y, x, yaw, indexing="ij"), axis=-1)[..., [1, 0, 2]].reshape(-1, 3)
    mine = _log_density(poses, own)
    lost = np.zeros(len(poses), dtype=np.bool_)
    for other in others:
        lost |= _log_density(poses, other) > mine
    log_prob = np.where(lost.reshape(patch.log_prob.shape), np.float32(patch.floor), patch.log_prob)
    return replace(patch, log_prob=log_prob)


def _log_density(poses: FloatArray, gaussian: Gaussian) -> FloatArray:
    """Of poses (N, 3), up to a constant."""
    mean, covariance = gaussian
    off = poses - mean
    off[:, 2] = se2.wrap(off[:, 2])
    root = np.linalg.cholesky(covariance)
    white = off @ np.linalg.inv(root).T
    return np.asarray(-0.5 * np.einsum("ni,ni->n", white, white) - np.log(np.diagonal(root)).sum())
