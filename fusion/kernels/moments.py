"""Moments of a weighted cloud in one pass, block by block, about a reference pose that was chosen before it.

Positions are moved to their mean by algebra. Headings live on a circle: with d = wrap(yaw - reference) and a the mean
direction as seen from the reference, the residual about the mean is d - a, but for the headings on the arc between the
antipodes of the two, where it is a full turn more or less. What lies there is summed up by `arc_blocks`, and only when
the cloud is so wide that something can.

Source: streaming log-sum-exp with one maximum a block; circular means after Mardia, Jupp, "Directional statistics",
1999, 2.2.
"""

import numba
import numpy as np

from fusion.kernels.float_math import INLINED, KERNEL, F, exp, larger, sine_cosine, widest, wrap
from fusion.kernels.layout import (
    ADDED,
    ARC,
    ARC_D,
    ARC_X,
    ARC_Y,
    BLOCK,
    FAR,
    LARGEST,
    LOG_SHIFT,
    REFERENCE_X,
    REFERENCE_Y,
    REFERENCE_YAW,
    SQUARED,
    SUM_COS,
    SUM_D,
    SUM_DD,
    SUM_SIN,
    SUM_X,
    SUM_XD,
    SUM_XX,
    SUM_XY,
    SUM_Y,
    SUM_YD,
    SUM_YY,
    SUMS,
    WEIGHT,
    Float32s,
    Float64s,
    T,
    X,
    Y,
)


@numba.njit(**INLINED)
def block_moments(
    start: int,
    n: int,
    log_weights: Float64s,
    out: Float64s,
    look: Float64s,
    s: Float32s,
    weights: Float32s,
    sums: Float64s,
) -> None:
    """New weights of a block, also as logarithms, and the sums of its moments about the reference pose."""
    widest()
    if log_weights.size > 0:
        shift = look[LOG_SHIFT]
        for j in range(n):
            value = (log_weights[start + j] - shift) + s[ADDED + j]
            out[start + j] = value
            s[ADDED + j] = F(value)
    else:
        for j in range(n):
            out[start + j] = s[ADDED + j]
    largest = F(-3e38)
    for j in range(n):
        largest = larger(s[ADDED + j], largest)
    rx, ry, rt = F(look[REFERENCE_X]), F(look[REFERENCE_Y]), F(look[REFERENCE_YAW])
    total, squared = F(0), F(0)
    sum_x, sum_y, sum_d, sum_s, sum_c = F(0), F(0), F(0), F(0), F(0)
    xx, xy, yy, xd, yd, dd, far = F(0), F(0), F(0), F(0), F(0), F(0), F(0)
    for j in range(n):
        w = exp(s[ADDED + j] - largest)
        s[ADDED + j] = w  # not yet among the weights: a store elsewhere may make the sums wait for a check at run time
        x, y, d = s[X + j] - rx, s[Y + j] - ry, wrap(s[T + j] - rt)
        sine, cosine = sine_cosine(d)
        total += w
        squared += w * w
        sum_s += w * sine
        sum_c += w * cosine
        wx, wy, wd = w * x, w * y, w * d
        sum_x += wx
        sum_y += wy
        sum_d += wd
        xx += wx * x
        xy += wx * y
        yy += wy * y
        xd += wd * x
        yd += wd * y
        dd += wd * d
        far = larger(larger(d, -d), far)
    for j in range(n):
        weights[start + j] = s[ADDED + j]
    sums[0], sums[1], sums[2] = largest, total, squared
    sums[3], sums[4], sums[5], sums[6] = sum_x, sum_y, sum_s, sum_c
    sums[7], sums[8], sums[9] = xx, xy, yy
    sums[10], sums[11], sums[12], sums[13], sums[14] = sum_d, xd, yd, dd, far
    sums[15], sums[16], sums[17], sums[18] = 0.0, 0.0, 0.0, 0.0


@numba.njit(**KERNEL)
def arc_blocks(
    first: int,
    last: int,
    cloud: Float32s,
    weights: Float32s,
    look: Float64s,
    low: float,
    high: float,
    sums: Float64s,
) -> None:
    """Sums over the particles whose d = wrap(yaw - reference) lies in [low, high), for blocks `first` to `last`.

    Parameters
    ----------
    cloud
        (3 N,) x, y, yaw.
    weights
        (N,) as the pass before left them.
    look
        The reference of that pass.
    sums
        (blocks, SUMS) of that pass, to which these are added.
    """
    widest()
    count = cloud.size // 3
    rx, ry, rt = F(look[REFERENCE_X]), F(look[REFERENCE_Y]), F(look[REFERENCE_YAW])
    least, most = F(low), F(high)
    for block in range(first, last):
        start = block * BLOCK
        stop = min(start + BLOCK, count)
        total, sum_x, sum_y, sum_d = F(0), F(0), F(0), F(0)
        for i in range(start, stop):
            d = wrap(cloud[2 * count + i] - rt)
            w = weights[i] if (d >= least) & (d < most) else F(0)
            total += w
            sum_x += w * (cloud[i] - rx)
            sum_y += w * (cloud[count + i] - ry)
            sum_d += w * d
        sums[block, ARC], sums[block, ARC_X], sums[block, ARC_Y], sums[block, ARC_D] = total, sum_x, sum_y, sum_d


@numba.njit(**KERNEL)
def combined(sums: Float64s, look: Float64s) -> tuple[float, ...]:
    """Moments of a whole cloud from those of its blocks, added in order.

    Returns
    -------
    13 numbers: the largest log weight, ln of the sum of the weights, the effective sample size; x and y of the mean,
    and its yaw as seen from the reference; the covariance's xx, xy, yy, xt, yt, tt about it; and how far the yaws lie
    from the reference, at most. No correction for the sample's size.
    """
    largest = sums[0, LARGEST]
    for block in range(1, len(sums)):
        largest = max(largest, sums[block, LARGEST])
    t = np.zeros(SUMS)
    for block in range(len(sums)):
        scale = np.exp(sums[block, LARGEST] - largest)
        t[WEIGHT] += sums[block, WEIGHT] * scale
        t[SQUARED] += sums[block, SQUARED] * (scale * scale)
        for column in range(SUM_X, FAR):
            t[column] += sums[block, column] * scale
        t[FAR] = max(t[FAR], sums[block, FAR])
        for column in range(ARC, SUMS):
            t[column] += sums[block, column] * scale
    share = 1.0 / t[WEIGHT]
    x, y, d = t[SUM_X] * share, t[SUM_Y] * share, t[SUM_D] * share
    yaw = np.arctan2(t[SUM_SIN], t[SUM_COS])
    turn = 2.0 * np.pi if yaw > 0.0 else -2.0 * np.pi
    arc, arc_x, arc_y, arc_d = t[ARC] * share, t[ARC_X] * share, t[ARC_Y] * share, t[ARC_D] * share
    tt = t[SUM_DD] * share - yaw * (2.0 * d - yaw) + turn * (2.0 * (arc_d - yaw * arc) + turn * arc)
    return (
        largest,
        np.log(t[WEIGHT]) + largest,
        t[WEIGHT] * t[WEIGHT] / t[SQUARED],
        look[REFERENCE_X] + x,
        look[REFERENCE_Y] + y,
        yaw,
        max(t[SUM_XX] * share - x * x, 0.0),
        t[SUM_XY] * share - x * y,
        max(t[SUM_YY] * share - y * y, 0.0),
        t[SUM_XD] * share - x * d + turn * (arc_x - x * arc),
        t[SUM_YD] * share - y * d + turn * (arc_y - y * arc),
        max(tt, 0.0),
        t[FAR],
    )
