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
from fusion.graph.chain_steps import motion_error, predicted, prior_deviation, times_site

_HALVINGS = 12
_SLACK = 1e-9


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
        motion_error(poses[k], poses[k + 1], deltas[k], residual, inverse)
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
    prior_deviation(poses[0], prior_mean, prior_covariance, mean, around, residual, inverse)
    times_site(poses[0], reference, site_precision, site_information, mean, around)
    predicted(
        poses[0], poses[1], delta, spread, precision, huber_width, mean, around, by_first, next_mean, next_covariance,
        noise,
    )  # fmt: skip
    next_mean += poses[1]
    next_mean[2] = wrap(next_mean[2])


@numba.njit(**OPTIONS)
def _marginals(
    gains: NDArray[np.float64],
    by_first: NDArray[np.float64],
    noises: NDArray[np.float64],
    filtered: NDArray[np.float64],
    covariances: NDArray[np.float64],
) -> None:
    """Covariances given everything from those given the past, backward."""
    last, rest, outer = len(filtered) - 1, np.empty((3, 3)), np.empty((3, 3))
    covariances[last] = filtered[last]
    for k in range(last - 1, -1, -1):
        product(gains[k], by_first[k], rest)
        for i in range(3):
            for j in range(3):
                rest[i, j] = (1.0 if i == j else 0.0) - rest[i, j]
                outer[i, j] = noises[k, i, j] + covariances[k + 1, i, j]
        covariances[k] = 0.0
        add_square(rest, filtered[k], 1.0, covariances[k])
        add_square(gains[k], outer, 1.0, covariances[k])


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
    gains, tried = np.empty((count, 3, 3)), np.empty((count, 3))
    back, rest, prior_precision, precisions = (
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((count - 1, 3, 3)),
    )
    invert(prior_covariance, prior_precision)
    for k in range(count - 1):
        invert(spreads[k], precisions[k])
    cost = chain_cost(
        poses, prior_mean, prior_precision, deltas, precisions, huber_width, references, site_precisions,
        site_informations,
    )  # fmt: skip
    taken = 0
    for step in range(most_steps):
        prior_deviation(poses[0], prior_mean, prior_covariance, ahead[0], ahead_spread[0], residual, inverse)
        for k in range(count):
            means[k], filtered[k] = ahead[k], ahead_spread[k]
            times_site(poses[k], references[k], site_precisions[k], site_informations[k], means[k], filtered[k])
            if k + 1 < count:
                predicted(
                    poses[k], poses[k + 1], deltas[k], spreads[k], precisions[k], huber_width, means[k], filtered[k],
                    by_first[k], ahead[k + 1], ahead_spread[k + 1], noises[k],
                )  # fmt: skip
        for k in range(count - 2, -1, -1):
            invert(ahead_spread[k + 1], back)
            for i in range(3):
                for j in range(3):
                    rest[i, j] = 0.0
                    for m in range(3):
                        rest[i, j] += filtered[k, i, m] * by_first[k, j, m]
            gain = gains[k]
            product(rest, back, gain)
            for i in range(3):
                for m in range(3):
                    means[k, i] += gain[i, m] * (means[k + 1, m] - ahead[k + 1, m])
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
        taken = step + 1
        if np.abs(means).max() < tolerance:
            break
    _marginals(gains, by_first, noises, filtered, covariances)
    return taken
