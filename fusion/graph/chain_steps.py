"""The steps along a chain of poses: the prior, a motion, a site, each linearised at the present poses."""

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.graph.chain_algebra import OPTIONS, add_square, invert, log_error, product, square_length, wrap


@numba.njit(**OPTIONS)
def prior_deviation(
    pose: NDArray[np.float64],
    mean: NDArray[np.float64],
    covariance: NDArray[np.float64],
    offset: NDArray[np.float64],
    spread: NDArray[np.float64],
    residual: NDArray[np.float64],
    inverse: NDArray[np.float64],
) -> None:
    """Mean (3,) and covariance (3, 3) of the deviation from `pose` that a prior says."""
    cos, sin, turned = np.cos(mean[2]), np.sin(mean[2]), np.zeros((3, 3))
    x, y = pose[0] - mean[0], pose[1] - mean[1]
    log_error(mean[2], cos * x + sin * y, cos * y - sin * x, wrap(pose[2] - mean[2]), residual, inverse)
    turn = np.zeros((3, 3))  # to the prior's axes
    turn[0, 0], turn[0, 1], turn[1, 0], turn[1, 1], turn[2, 2] = cos, sin, -sin, cos, 1.0
    product(inverse, turn, turned)
    spread[:] = 0.0
    add_square(turned, covariance, 1.0, spread)
    for i in range(3):
        offset[i] = -(inverse[i, 0] * residual[0] + inverse[i, 1] * residual[1] + inverse[i, 2] * residual[2])


@numba.njit(**OPTIONS)
def motion_error(
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    delta: NDArray[np.float64],
    residual: NDArray[np.float64],
    inverse: NDArray[np.float64],
) -> None:
    """Residual of a motion and the inverse of its derivative by the second pose."""
    turn = first[2] + delta[2]
    cos, sin = np.cos(turn), np.sin(turn)
    x, y = second[0] - first[0], second[1] - first[1]
    ahead, aside = cos * x + sin * y, cos * y - sin * x
    cos, sin = np.cos(delta[2]), np.sin(delta[2])
    ahead -= cos * delta[0] + sin * delta[1]
    aside -= cos * delta[1] - sin * delta[0]
    log_error(turn, ahead, aside, wrap(second[2] - turn), residual, inverse)


@numba.njit(**OPTIONS)
def predicted(
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    delta: NDArray[np.float64],
    covariance: NDArray[np.float64],
    precision: NDArray[np.float64],
    huber_width: float,
    mean: NDArray[np.float64],
    spread: NDArray[np.float64],
    by_first: NDArray[np.float64],
    next_mean: NDArray[np.float64],
    next_spread: NDArray[np.float64],
    noise: NDArray[np.float64],
) -> None:
    """The deviation of a second pose from that of a first, `mean` and `spread`, by a motion between them.

    Written: the motion's derivative F, the mean (3,), the covariance (3, 3) and the part of it that is noise.
    """
    residual, inverse, turned, turn = np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.zeros((3, 3))
    motion_error(first, second, delta, residual, inverse)
    length = np.sqrt(max(square_length(residual, delta[2], precision), 0.0))
    cos, sin = np.cos(delta[2]), np.sin(delta[2])
    turn[0, 0], turn[0, 1], turn[1, 0], turn[1, 1], turn[2, 2] = cos, sin, -sin, cos, 1.0
    product(inverse, turn, turned)
    noise[:] = 0.0
    add_square(turned, covariance, max(1.0, length / huber_width), noise)
    by_first[:] = 0.0
    for i in range(3):
        by_first[i, i] = 1.0
    by_first[0, 2], by_first[1, 2] = first[1] - second[1], second[0] - first[0]
    next_spread[:] = noise
    add_square(by_first, spread, 1.0, next_spread)
    for i in range(3):
        next_mean[i] = by_first[i, 0] * mean[0] + by_first[i, 1] * mean[1] + by_first[i, 2] * mean[2]
        next_mean[i] -= inverse[i, 0] * residual[0] + inverse[i, 1] * residual[1] + inverse[i, 2] * residual[2]


@numba.njit(**OPTIONS)
def times_site(
    pose: NDArray[np.float64],
    reference: NDArray[np.float64],
    precision: NDArray[np.float64],
    information: NDArray[np.float64],
    mean: NDArray[np.float64],
    spread: NDArray[np.float64],
) -> None:
    """Multiply the deviation's Gaussian by a site, in place."""
    off, vector = np.empty(3), np.empty(3)
    for i in range(3):
        off[i] = reference[i] - pose[i]
    off[2] = wrap(off[2])
    for i in range(3):
        vector[i] = information[i]
        for j in range(3):
            vector[i] += precision[i, j] * (off[j] - mean[j])
    total, shrunk = np.empty((3, 3)), np.empty((3, 3))
    product(spread, precision, total)
    for i in range(3):
        total[i, i] += 1.0
    invert(total, shrunk)
    gained, after = np.empty((3, 3)), np.zeros((3, 3))
    product(shrunk, spread, gained)
    add_square(shrunk, spread, 1.0, after)
    add_square(gained, precision, 1.0, after)
    spread[:] = after
    for i in range(3):
        mean[i] += after[i, 0] * vector[0] + after[i, 1] * vector[1] + after[i, 2] * vector[2]
