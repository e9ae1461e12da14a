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

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

_HALVINGS = 12
_SLACK = 1e-9
_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
_TWO_PI = 2.0 * np.pi


@numba.njit(inline="always", **_OPTIONS)
def _wrap(angle: float) -> float:
    return angle - _TWO_PI * np.floor((angle + np.pi) / _TWO_PI)


@numba.njit(**_OPTIONS)
def _product(a: NDArray[np.float64], b: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@numba.njit(**_OPTIONS)
def _add_square(a: NDArray[np.float64], middle: NDArray[np.float64], scale: float, out: NDArray[np.float64]) -> None:
    """``out += scale * a middle a^T``, symmetric to the bit."""
    for i in range(3):
        x = a[i, 0] * middle[0, 0] + a[i, 1] * middle[1, 0] + a[i, 2] * middle[2, 0]
        y = a[i, 0] * middle[0, 1] + a[i, 1] * middle[1, 1] + a[i, 2] * middle[2, 1]
        z = a[i, 0] * middle[0, 2] + a[i, 1] * middle[1, 2] + a[i, 2] * middle[2, 2]
        for j in range(i + 1):
            value = scale * (x * a[j, 0] + y * a[j, 1] + z * a[j, 2])
            out[i, j] += value
            if i != j:
                out[j, i] += value


@numba.njit(**_OPTIONS)
def _invert(a: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Inverse by cofactors."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for m in range(3):
            n, o = (m + 1) % 3, (m + 2) % 3
            out[m, i] = a[j, n] * a[k, o] - a[j, o] * a[k, n]
    scale = 1.0 / (a[0, 0] * out[0, 0] + a[0, 1] * out[1, 0] + a[0, 2] * out[2, 0])
    for i in range(3):
        for j in range(3):
            out[i, j] *= scale


@numba.njit(**_OPTIONS)
def _log_error(
    turn: float, x: float, y: float, yaw: float, residual: NDArray[np.float64], inverse: NDArray[np.float64]
) -> None:
    """``log`` of an error that is (x, y) on axes turned by `turn` from the map's, and `yaw`.

    Written: the residual, and the inverse (3, 3) of its derivative by the deviation on the axes of the map.
    """
    cos, sin = np.cos(turn), np.sin(turn)
    half = 0.5 * yaw
    if abs(half) < 1e-4:
        a, slope = 1.0 - half * half / 3.0, -half / 3.0
    else:
        a = half * np.cos(half) / np.sin(half)
        slope = 0.5 * (np.cos(half) / np.sin(half) - half / np.sin(half) ** 2)
    residual[0], residual[1], residual[2] = a * x + half * y, -half * x + a * y, yaw
    # derivative by the error: [[a, half, p], [-half, a, q], [0, 0, 1]]; by the deviation: that times a turn back
    p, q = slope * x + 0.5 * y, slope * y - 0.5 * x
    scale = 1.0 / (a * a + half * half)
    i00, i01, i10, i11 = a * scale, -half * scale, half * scale, a * scale
    i02, i12 = -(i00 * p + i01 * q), -(i10 * p + i11 * q)
    inverse[0, 0], inverse[0, 1], inverse[0, 2] = cos * i00 - sin * i10, cos * i01 - sin * i11, cos * i02 - sin * i12
    inverse[1, 0], inverse[1, 1], inverse[1, 2] = sin * i00 + cos * i10, sin * i01 + cos * i11, sin * i02 + cos * i12
    inverse[2, 0], inverse[2, 1], inverse[2, 2] = 0.0, 0.0, 1.0


@numba.njit(**_OPTIONS)
def _square_length(residual: NDArray[np.float64], turn: float, precision: NDArray[np.float64]) -> float:
    """``r^T R P R^T r`` for a precision P on axes that are turned by `-turn` from the residual's."""
    cos, sin = np.cos(turn), np.sin(turn)
    x, y, z = cos * residual[0] - sin * residual[1], sin * residual[0] + cos * residual[1], residual[2]
    cross = precision[0, 1] * x * y + precision[0, 2] * x * z + precision[1, 2] * y * z
    return float(precision[0, 0] * x * x + precision[1, 1] * y * y + precision[2, 2] * z * z + 2.0 * cross)


@numba.njit(**_OPTIONS)
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
    _log_error(mean[2], cos * x + sin * y, cos * y - sin * x, _wrap(pose[2] - mean[2]), residual, inverse)
    turn = np.zeros((3, 3))  # to the prior's axes
    turn[0, 0], turn[0, 1], turn[1, 0], turn[1, 1], turn[2, 2] = cos, sin, -sin, cos, 1.0
    _product(inverse, turn, turned)
    spread[:] = 0.0
    _add_square(turned, covariance, 1.0, spread)
    for i in range(3):
        offset[i] = -(inverse[i, 0] * residual[0] + inverse[i, 1] * residual[1] + inverse[i, 2] * residual[2])


@numba.njit(**_OPTIONS)
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
    _log_error(turn, ahead, aside, _wrap(second[2] - turn), residual, inverse)


@numba.njit(**_OPTIONS)
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
    length = np.sqrt(max(_square_length(residual, delta[2], precision), 0.0))
    cos, sin = np.cos(delta[2]), np.sin(delta[2])
    turn[0, 0], turn[0, 1], turn[1, 0], turn[1, 1], turn[2, 2] = cos, sin, -sin, cos, 1.0
    _product(inverse, turn, turned)
    noise[:] = 0.0
    _add_square(turned, covariance, max(1.0, length / huber_width), noise)
    by_first[:] = 0.0
    for i in range(3):
        by_first[i, i] = 1.0
    by_first[0, 2], by_first[1, 2] = first[1] - second[1], second[0] - first[0]
    next_spread[:] = noise
    _add_square(by_first, spread, 1.0, next_spread)
    for i in range(3):
        next_mean[i] = by_first[i, 0] * mean[0] + by_first[i, 1] * mean[1] + by_first[i, 2] * mean[2]
        next_mean[i] -= inverse[i, 0] * residual[0] + inverse[i, 1] * residual[1] + inverse[i, 2] * residual[2]


@numba.njit(**_OPTIONS)
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
    off[2] = _wrap(off[2])
    for i in range(3):
        vector[i] = information[i]
        for j in range(3):
            vector[i] += precision[i, j] * (off[j] - mean[j])
    total, shrunk = np.empty((3, 3)), np.empty((3, 3))
    _product(spread, precision, total)
    for i in range(3):
        total[i, i] += 1.0
    _invert(total, shrunk)
    gained, after = np.empty((3, 3)), np.zeros((3, 3))
    _product(shrunk, spread, gained)
    _add_square(shrunk, spread, 1.0, after)
    _add_square(gained, precision, 1.0, after)
    spread[:] = after
    for i in range(3):
        mean[i] += after[i, 0] * vector[0] + after[i, 1] * vector[1] + after[i, 2] * vector[2]


@numba.njit(**_OPTIONS)
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
    turn = _wrap(poses[0, 2] - prior_mean[2])
    _log_error(prior_mean[2], cos * x + sin * y, cos * y - sin * x, turn, residual, inverse)
    total = 0.5 * _square_length(residual, prior_mean[2], prior_precision)
    for k in range(len(deltas)):
        _motion_error(poses[k], poses[k + 1], deltas[k], residual, inverse)
        length = np.sqrt(max(_square_length(residual, deltas[k, 2], precisions[k]), 0.0))
        width = min(huber_width, length)
        total += width * (length - 0.5 * width)
    off = np.empty(3)
    for k in range(len(poses)):
        for i in range(3):
            off[i] = poses[k, i] - references[k, i]
        off[2] = _wrap(off[2])
        for i in range(3):
            total -= site_informations[k, i] * off[i]
            for j in range(3):
                total += 0.5 * off[i] * site_precisions[k, i, j] * off[j]
    return float(total)


@numba.njit(**_OPTIONS)
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
    _invert(spread, precision)
    _prior(poses[0], prior_mean, prior_covariance, mean, around, residual, inverse)
    _measured(poses[0], reference, site_precision, site_information, mean, around)
    predicted(
        poses[0], poses[1], delta, spread, precision, huber_width, mean, around, by_first, next_mean, next_covariance,
        noise,
    )  # fmt: skip
    next_mean += poses[1]
    next_mean[2] = _wrap(next_mean[2])


@numba.njit(**_OPTIONS)
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
    _invert(prior_covariance, prior_precision)
    for k in range(count - 1):
        _invert(spreads[k], precisions[k])
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
            _invert(ahead_spread[k + 1], back)
            for i in range(3):
                for j in range(3):
                    rest[i, j] = 0.0
                    for m in range(3):
                        rest[i, j] += filtered[k, i, m] * by_first[k, j, m]
            _product(rest, back, gain)
            for i in range(3):
                for m in range(3):
                    means[k, i] += gain[i, m] * (means[k + 1, m] - ahead[k + 1, m])
            _product(gain, by_first[k], rest)
            for i in range(3):
                for j in range(3):
                    rest[i, j] = (1.0 if i == j else 0.0) - rest[i, j]
                    outer[i, j] = noises[k, i, j] + covariances[k + 1, i, j]
            covariances[k] = 0.0
            _add_square(rest, filtered[k], 1.0, covariances[k])
            _add_square(gain, outer, 1.0, covariances[k])
        share, reached = 1.0, np.inf
        for _ in range(_HALVINGS):
            for k in range(count):
                for i in range(3):
                    tried[k, i] = poses[k, i] + share * means[k, i]
                tried[k, 2] = _wrap(tried[k, 2])
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
