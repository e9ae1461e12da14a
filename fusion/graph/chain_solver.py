"""A chain of poses solved in one compiled pass: Gauss-Newton as an iterated Kalman smoother, forward and backward.

The factors are GTSAM's own: a prior and motions with the residual ``log(z^-1 h(x))``, Huber's loss on the motions, and
a quadratic on each pose. Linearised, with deviations d from the present poses on the axes of the map, a motion says

    d_k+1 = F d_k - G r + G n,    n ~ N(0, Q / w),

with the residual r, its weight w, and the inverse G of its derivative by d_k+1. Covariances take the place of
information matrices, so that odometry without errors is no special case, and every covariance is a sum of squares.

GTSAM solves the same chain, but for a hundred poses it spends more time on passing factors from Python than on solving.
It is the reference that this is tested against, steps, covariances and all.

Sources: Bell, "The iterated Kalman smoother as a Gauss-Newton method", SIAM Journal on Optimization, 1994; Rauch, Tung,
Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA Journal, 1965; the form of the covariances:
Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and navigation", 2001, 5.4.2.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.graph.chain_algebra import OPTIONS, add_square, invert, log_error, product, square_length, wrap

_HALVINGS = 12
_SLACK = 1e-9


@numba.njit(**OPTIONS)
def _prior(
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
def _motion_error(
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
    _motion_error(first, second, delta, residual, inverse)
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
def _measured(
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


@numba.njit(**OPTIONS)
def chain_cost(
    poses: NDArray[np.float64],
    prior_mean: NDArray[np.float64],
    prior_precision: NDArray[np.float64],
    deltas: NDArray[np.float64],
    precisions: NDArray[np.float64],
    huber_width: float,
    references: NDArray[np.float64],
    site_precisions: NDArray[np.float64],
    site_informations: NDArray[np.float64],
) -> float:
    """Minus the log of all factors at poses (N, 3), up to a constant."""
    residual, inverse = np.empty(3), np.empty((3, 3))
    cos, sin = np.cos(prior_mean[2]), np.sin(prior_mean[2])
    x, y = poses[0, 0] - prior_mean[0], poses[0, 1] - prior_mean[1]
    turn = wrap(poses[0, 2] - prior_mean[2])
    log_error(prior_mean[2], cos * x + sin * y, cos * y - sin * x, turn, residual, inverse)
    total = 0.5 * square_length(residual, prior_mean[2], prior_precision)
    for k in range(len(deltas)):
        _motion_error(poses[k], poses[k + 1], deltas[k], residual, inverse)
        length = np.sqrt(max(square_length(residual, deltas[k, 2], precisions[k]), 0.0))
        width = min(huber_width, length)
        total += width * (length - 0.5 * width)
    off = np.empty(3)
    for k in range(len(poses)):
        for i in range(3):
            off[i] = poses[k, i] - references[k, i]
        off[2] = wrap(off[2])
        for i in range(3):
            total -= site_informations[k, i] * off[i]
            for j in range(3):
                total += 0.5 * off[i] * site_precisions[k, i, j] * off[j]
    return float(total)


@numba.njit(**OPTIONS)
def without_first(
    poses: NDArray[np.float64],
    prior_mean: NDArray[np.float64],
    prior_covariance: NDArray[np.float64],
    delta: NDArray[np.float64],
    spread: NDArray[np.float64],
    huber_width: float,
    reference: NDArray[np.float64],
    site_precision: NDArray[np.float64],
    site_information: NDArray[np.float64],
    next_mean: NDArray[np.float64],
    next_covariance: NDArray[np.float64],
) -> None:
    """The second of two poses (2, 3) given all that there is on the first, linearised at both.

    Written: a pose (3,) and a covariance (3, 3) on the axes of the map.
    """
    mean, around, residual, inverse = np.empty(3), np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    by_first, noise, precision = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    invert(spread, precision)
    _prior(poses[0], prior_mean, prior_covariance, mean, around, residual, inverse)
    _measured(poses[0], reference, site_precision, site_information, mean, around)
    predicted(
        poses[0], poses[1], delta, spread, precision, huber_width, mean, around, by_first, next_mean, next_covariance,
        noise,
    )  # fmt: skip
    next_mean += poses[1]
    next_mean[2] = wrap(next_mean[2])


@numba.njit(**OPTIONS)
def solve_chain(
    poses: NDArray[np.float64],
    prior_mean: NDArray[np.float64],
    prior_covariance: NDArray[np.float64],
    deltas: NDArray[np.float64],
    spreads: NDArray[np.float64],
    huber_width: float,
    references: NDArray[np.float64],
    site_precisions: NDArray[np.float64],
    site_informations: NDArray[np.float64],
    most_steps: int,
    tolerance: float,
    covariances: NDArray[np.float64],
) -> int:
    """Gauss-Newton steps, each halved until the cost does not grow, until one is short.

    Parameters
    ----------
    poses : (N, 3) float64
        Start, and the result.
    prior_mean, prior_covariance : (3,), (3, 3) float64
        Of the first pose, map axes.
    deltas, spreads : (N - 1, 3), (N - 1, 3, 3) float64
        Motions and their covariances, positive definite, on the axes of the body where each begins.
    huber_width : float
        Motions' residuals beyond so many standard deviations count less; infinity for no robust loss.
    references, site_precisions, site_informations : (N, 3), (N, 3, 3), (N, 3) float64
        See `fusion.graph.sites`; zeros where nothing was measured.
    most_steps, tolerance : int, float
        When to stop; metres and radians.
    covariances : (N, 3, 3) float64
        Written: marginals on the axes of the map, linearised one step before the result.

    Returns
    -------
    int
        Number of steps.
    """
    count = len(poses)
    ahead, ahead_spread = np.empty((count, 3)), np.empty((count, 3, 3))  # before the pose's own site
    means, filtered = np.empty((count, 3)), np.empty((count, 3, 3))  # after it
    by_first, noises = np.empty((count, 3, 3)), np.empty((count, 3, 3))
    residual, inverse = np.empty(3), np.empty((3, 3))
    back, gain, rest, tried = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((count, 3))
    outer, prior_precision, precisions = np.empty((3, 3)), np.empty((3, 3)), np.empty((count - 1, 3, 3))
    invert(prior_covariance, prior_precision)
    for k in range(count - 1):
        invert(spreads[k], precisions[k])
    cost = chain_cost(
        poses, prior_mean, prior_precision, deltas, precisions, huber_width, references, site_precisions,
        site_informations,
    )  # fmt: skip
    for step in range(most_steps):
        _prior(poses[0], prior_mean, prior_covariance, ahead[0], ahead_spread[0], residual, inverse)
        for k in range(count):
            means[k], filtered[k] = ahead[k], ahead_spread[k]
            _measured(poses[k], references[k], site_precisions[k], site_informations[k], means[k], filtered[k])
            if k + 1 < count:
                predicted(
                    poses[k], poses[k + 1], deltas[k], spreads[k], precisions[k], huber_width, means[k], filtered[k],
                    by_first[k], ahead[k + 1], ahead_spread[k + 1], noises[k],
                )  # fmt: skip
        covariances[count - 1] = filtered[count - 1]
        for k in range(count - 2, -1, -1):
            invert(ahead_spread[k + 1], back)
            for i in range(3):
                for j in range(3):
                    rest[i, j] = 0.0
                    for m in range(3):
                        rest[i, j] += filtered[k, i, m] * by_first[k, j, m]
            product(rest, back, gain)
            for i in range(3):
                for m in range(3):
                    means[k, i] += gain[i, m] * (means[k + 1, m] - ahead[k + 1, m])
            product(gain, by_first[k], rest)
            for i in range(3):
                for j in range(3):
                    rest[i, j] = (1.0 if i == j else 0.0) - rest[i, j]
                    outer[i, j] = noises[k, i, j] + covariances[k + 1, i, j]
            covariances[k] = 0.0
            add_square(rest, filtered[k], 1.0, covariances[k])
            add_square(gain, outer, 1.0, covariances[k])
        share, reached = 1.0, np.inf
        for _ in range(_HALVINGS):
            for k in range(count):
                for i in range(3):
                    tried[k, i] = poses[k, i] + share * means[k, i]
                tried[k, 2] = wrap(tried[k, 2])
            reached = chain_cost(
                tried, prior_mean, prior_precision, deltas, precisions, huber_width, references, site_precisions,
                site_informations,
            )  # fmt: skip
            if reached <= cost + _SLACK * (1.0 + abs(cost)):
                break
            share *= 0.5
        cost = reached
        poses[:] = tried
        if np.abs(means).max() < tolerance:
            return step + 1
    return most_steps
