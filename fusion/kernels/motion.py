"""Moving a block of particles: normals from a counter, the ancestors' poses, kernel noise, the odometry's noise."""

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.kernels.float_math import INLINED, F, get, put, sine_cosine, take, widest, within_a_turn, wrap
from fusion.kernels.layout import BLOCK, CLUSTER_SIZE, E0, E1, E2, E3, E4, E5, Float32s, Float64s, Int32s, T, X, Y
from fusion.kernels.random import U, normal_pair, threefry

_WIDE = F(0.1)  # rad^2: normals of 5.8 standard deviations on two axes stay below half a turn for a lesser variance


@numba.njit(**INLINED)
def three_normals(
    start: int, n: int, step: np.uint32, stream: np.uint32, key: NDArray[np.uint32], row: int, s: Float32s
) -> None:
    """Normals for n particles from `start` on, into three rows of the scratch `s` from `row` on: E0 or E3.

    A counter gives six normals, which is enough for two particles: one of each half of the block.
    """
    widest()
    words = (key[0], key[1], key[2], key[3])
    first, other = start // 2, row + BLOCK // 2
    for j in range(min(n, BLOCK // 2)):
        a, b, c, d = threefry((U(first + j), step, stream, U(0)), words)
        s[row + j], s[row + BLOCK + j] = normal_pair(a, d)
        s[row + 2 * BLOCK + j], s[other + j] = normal_pair(b, U(d >> U(10)))
        s[other + BLOCK + j], s[other + 2 * BLOCK + j] = normal_pair(c, U(d >> U(20)))


@numba.njit(**INLINED)
def fetch(source: Float32s, ancestors: Int32s, start: int, n: int, s: Float32s) -> None:
    """Read the ancestors of a block, or the block itself when nothing has been resampled."""
    widest()
    size = source.size // 3
    for axis in range(3):
        offset = axis * size
        if ancestors.size == 0:
            for j in range(n):
                s[axis * BLOCK + j] = source[offset + start + j]
        else:
            column = source[offset : offset + size]
            for j in range(n):
                put(s, axis * BLOCK + j, take(column, take(ancestors, np.int32(start + j))))


@numba.njit(**INLINED)
def regularise(n: int, motion: Float64s, s: Float32s) -> None:
    """Draw a block towards the mean and add kernel noise, see `fusion.particles.regularisation`."""
    widest()
    mx, my, mt, shrink = F(motion[14]), F(motion[15]), F(motion[16]), F(motion[17])
    r00, r10, r11 = F(motion[18]), F(motion[21]), F(motion[22])
    r20, r21, r22 = F(motion[24]), F(motion[25]), F(motion[26])
    for j in range(n):
        e0, e1, e2 = s[E3 + j], s[E4 + j], s[E5 + j]
        s[X + j] = mx + shrink * (s[X + j] - mx) + r00 * e0
        s[Y + j] = my + shrink * (s[Y + j] - my) + (r10 * e0 + r11 * e1)
        turned = mt + shrink * wrap(s[T + j] - mt)
        s[T + j] = wrap(turned + (r20 * e0 + r21 * e1 + r22 * e2))


@numba.njit(**INLINED)
def regularise_in_clusters(start: int, n: int, labels: Int32s, clusters: Float32s, s: Float32s) -> None:
    """As `regularise`, with the mean, factor and root of each particle's own cluster: `CLUSTER_SIZE` numbers each."""
    widest()
    for j in range(n):
        c = np.int32(take(labels, np.int32(start + j)) * np.int32(CLUSTER_SIZE))
        mx, my, mt = take(clusters, c), take(clusters, np.int32(c + 1)), take(clusters, np.int32(c + 2))
        shrink, r00 = take(clusters, np.int32(c + 3)), take(clusters, np.int32(c + 4))
        r10, r11 = take(clusters, np.int32(c + 5)), take(clusters, np.int32(c + 6))
        r20, r21, r22 = (
            take(clusters, np.int32(c + 7)),
            take(clusters, np.int32(c + 8)),
            take(clusters, np.int32(c + 9)),
        )
        e0, e1, e2 = get(s, E3 + j), get(s, E4 + j), get(s, E5 + j)
        put(s, X + j, mx + shrink * (get(s, X + j) - mx) + r00 * e0)
        put(s, Y + j, my + shrink * (get(s, Y + j) - my) + (r10 * e0 + r11 * e1))
        turned = mt + shrink * wrap(get(s, T + j) - mt)
        put(s, T + j, wrap(turned + (r20 * e0 + r21 * e1 + r22 * e2)))


@numba.njit(**INLINED)
def advance(n: int, motion: Float64s, s: Float32s) -> None:
    """Compose a block with the increment and its noise; a heading's noise that can exceed half a turn is wrapped."""
    widest()
    dx, dy, dt = F(motion[0]), F(motion[1]), F(motion[2])
    r00, r10, r11 = F(motion[3]), F(motion[6]), F(motion[7])
    r20, r21, r22 = F(motion[9]), F(motion[10]), F(motion[11])
    sx, sy = F(motion[12]), F(motion[13])
    if r20 * r20 + r21 * r21 + r22 * r22 > _WIDE:
        for j in range(n):
            s[E2 + j] = within_a_turn(r20 * s[E0 + j] + r21 * s[E1 + j] + r22 * s[E2 + j])
        r20, r21, r22 = F(0), F(0), F(1)
    for j in range(n):
        e0, e1, e2 = s[E0 + j], s[E1 + j], s[E2 + j]
        yaw = s[T + j]
        forward = dx + r00 * e0
        left = dy + (r10 * e0 + r11 * e1)
        sine, cosine = sine_cosine(yaw)
        s[X + j] = (s[X + j] - sx) + (cosine * forward - sine * left)
        s[Y + j] = (s[Y + j] - sy) + (sine * forward + cosine * left)
        s[T + j] = wrap(yaw + (dt + (r20 * e0 + r21 * e1 + r22 * e2)))
