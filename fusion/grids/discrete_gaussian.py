"""Discrete Gaussians: probabilities of whole cells, never negative, whose mean and covariance are exact.

A Gaussian sampled at whole cells is one, up to aliasing, when it is wider than about 0.7 cells: the next moments then
differ by less than a thousandth. For narrower ones mean and covariance are corrected within the exponential family
``exp(-n A n / 2 + b n)`` of the same points, which is as near to a Gaussian as probabilities with these moments are.
What is narrower still stays on three cells, ``(v / 2, 1 - v, v / 2)`` for a variance of v cells squared.

Source: Kemp, "Characterizations of a discrete normal distribution", 1997 (the family, and that it has most entropy).
"""

import numba
import numpy as np

from fusion.arrays import Float32Array, FloatArray, IntArray

LEAST_PLANAR_VARIANCE = 0.3
"""Cells squared along the narrowest axis from which on `planar_gaussian` has any mean: a split needs up to 1/4."""
_THREE_TAPS = 1.0 / 3.0
_RADIUS_SIGMAS = 5.0
_NEWTON_STEPS = 12
_MOST_CORRECTIONS = 40
_TOLERANCE = 1e-6


def symmetric_taps(variances: FloatArray) -> Float32Array:
    """Halves of discrete Gaussians with exactly these variances, from the middle outward.

    Parameters
    ----------
    variances : (N,) float64
        Cells squared, >= 0.

    Returns
    -------
    (N, R + 1) float32
        Weight of the middle, of either neighbour, and so on: ``taps[0] + 2 taps[1:].sum() == 1``; zeros beyond the
        radius of a narrower one. R is at least 1.
    """
    widest = float(variances.max(initial=0.0))
    radius = 1 if widest <= _THREE_TAPS else int(np.ceil(_RADIUS_SIGMAS * np.sqrt(widest)))
    taps = np.zeros((len(variances), radius + 1))
    narrow = variances <= _THREE_TAPS
    taps[narrow, 1] = 0.5 * variances[narrow]
    wide = ~narrow
    if wide.any():
        taps[wide] = _sampled_gaussians(variances[wide], radius)
    half = taps.astype(np.float32)
    half[:, 0] = 1.0 - 2.0 * half[:, 1:].sum(axis=1, dtype=np.float64)
    return half


def _sampled_gaussians(variances: FloatArray, radius: int) -> FloatArray:
    """Gaussians sampled at 0 .. radius, each cut off at its own radius, whose variances are exact: Newton's method."""
    n = np.arange(radius + 1)
    inside = (n <= np.ceil(_RADIUS_SIGMAS * np.sqrt(variances))[:, None]).astype(np.float64)
    twice = np.where(n == 0, 1.0, 2.0)
    rate = 0.5 / variances  # weights exp(-rate n^2); d variance / d rate = variance^2 - fourth moment
    for _ in range(_NEWTON_STEPS):
        weights = inside * np.exp(-rate[:, None] * n**2)
        weights = weights / (weights @ twice)[:, None]
        second, fourth = weights @ (twice * n**2), weights @ (twice * n**4)
        rate = rate + (second - variances) / (fourth - second**2)
    weights = inside * np.exp(-rate[:, None] * n**2)
    return weights / (weights @ twice)[:, None]


@numba.njit(cache=True, nogil=True)
def planar_gaussian(
    mean: FloatArray, covariance: FloatArray, least: float, cells: IntArray, weights: FloatArray
) -> int:
    """A Gaussian over cells of a plane, into `cells` (P, 2) and `weights` (P,); how many cells it has.

    Parameters
    ----------
    mean : (2,) float64
        In cells, anywhere.
    covariance : (2, 2) float64
        Cells squared, no eigenvalue below `LEAST_PLANAR_VARIANCE`.
    least : float
        Cells of less density than this share of the peak's are left out: their mass is about as large a share.
    """
    xx, xy, yy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    determinant = xx * yy - xy * xy
    a, b, d = yy / determinant, -xy / determinant, xx / determinant  # the precision; corrected below
    reach = -2.0 * np.log(least)
    down, right = np.sqrt(reach * xx), np.sqrt(reach * yy)
    count = 0
    for r in range(int(np.ceil(mean[0] - down)), int(np.floor(mean[0] + down)) + 1):
        for c in range(int(np.ceil(mean[1] - right)), int(np.floor(mean[1] + right)) + 1):
            y, x = r - mean[0], c - mean[1]
            if a * y * y + 2.0 * b * y * x + d * x * x <= reach:
                cells[count, 0], cells[count, 1] = r, c
                count += 1
    tilt_y = tilt_x = 0.0
    for _ in range(_MOST_CORRECTIONS):
        total = sum_y = sum_x = sum_yy = sum_yx = sum_xx = 0.0
        for n in range(count):
            y, x = cells[n, 0] - mean[0], cells[n, 1] - mean[1]
            w = np.exp(-0.5 * (a * y * y + 2.0 * b * y * x + d * x * x) + tilt_y * y + tilt_x * x)
            weights[n] = w
            total += w
            sum_y += w * y
            sum_x += w * x
            sum_yy += w * y * y
            sum_yx += w * y * x
            sum_xx += w * x * x
        my, mx = sum_y / total, sum_x / total
        over_yy, over_yx, over_xx = sum_yy / total - xx, sum_yx / total - xy, sum_xx / total - yy
        if max(abs(my), abs(mx), abs(over_yy), abs(over_yx), abs(over_xx)) < _TOLERANCE * (1.0 + xx + yy):
            break
        # what a Gaussian's natural parameters would have to change by
        tilt_y, tilt_x = tilt_y - (a * my + b * mx), tilt_x - (b * my + d * mx)
        p, q = a * over_yy + b * over_yx, a * over_yx + b * over_xx
        s, t = b * over_yy + d * over_yx, b * over_yx + d * over_xx
        a, b, d = a + p * a + q * b, b + p * b + q * d, d + s * b + t * d
    for n in range(count):
        weights[n] /= total
    return count


@numba.njit(cache=True, nogil=True)
def planar_gaussians(
    means: FloatArray, covariances: FloatArray, least: FloatArray, most: int
) -> tuple[IntArray, IntArray, FloatArray]:
    """`planar_gaussian` for K covariances (K, 2, 2) and J means of each, (K, J, 2), with a `least` (J,) for each mean.

    Returns
    -------
    tuple of (K, J), (K, J, P, 2) and (K, J, P)
        How many cells, which, and their probabilities; P is `most`, at least what any of them can have.
    """
    sizes = np.empty(means.shape[:2], dtype=np.int64)
    cells = np.empty((*means.shape[:2], most, 2), dtype=np.int64)
    weights = np.empty((*means.shape[:2], most))
    for k in range(means.shape[0]):
        for j in range(means.shape[1]):
            sizes[k, j] = planar_gaussian(means[k, j], covariances[k], least[j], cells[k, j], weights[k, j])
    return sizes, cells, weights
