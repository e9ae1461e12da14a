"""Connected components of occupied cells of position and heading, and the moments of each, compiled by numba."""

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.kernels.float_math import INLINED, F, sine_cosine
from fusion.kernels.layout import BLOCK, E0, E1, E2, MOTION_STREAM, SCRATCH_SIZE
from fusion.kernels.motion import three_normals

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
_LEAST_MASS = 1e-300  # below about 1e-308 one over it is infinite


@numba.njit(**_OPTIONS)
def cells_of(
    poses: NDArray[np.float64], x0: float, y0: float, cell_m: float, cols: int, yaw_cells: int
) -> NDArray[np.int64]:
    """Cell of each pose (N, 3) in a grid of (rows, cols, yaw_cells) whose outermost rows and columns stay empty."""
    cells = np.empty(len(poses), np.int64)
    for i in range(len(poses)):
        row = int((poses[i, 0] - x0) / cell_m) + 1
        col = int((poses[i, 1] - y0) / cell_m) + 1
        turns = poses[i, 2] / (2.0 * np.pi)
        yaw = min(int((turns - np.floor(turns)) * yaw_cells), yaw_cells - 1)
        cells[i] = (row * cols + col) * yaw_cells + yaw
    return cells


@numba.njit(**_OPTIONS)
def components(cells: NDArray[Any], size: int, cols: int, yaw_cells: int) -> tuple[NDArray[Any], int]:
    """Label (N,) of each occupied cell in a grid of `size` cells, corners and the seam joined; and how many."""
    label_of = np.full(size, -1, np.int32)
    for cell in cells:
        label_of[cell] = -2  # occupied, not yet reached
    waiting = np.empty(min(len(cells), size), np.int64)
    count = 0
    for start in cells:
        if label_of[start] != -2:
            continue
        label_of[start] = count
        waiting[0] = start
        left = 1
        while left > 0:
            left -= 1
            place, yaw = divmod(waiting[left], yaw_cells)
            for drow in range(-1, 2):
                for dcol in range(-1, 2):
                    base = (place + drow * cols + dcol) * yaw_cells
                    for dyaw in range(-1, 2):
                        turned = yaw + dyaw
                        if turned < 0:
                            turned += yaw_cells
                        elif turned >= yaw_cells:
                            turned -= yaw_cells
                        near = base + turned
                        if label_of[near] == -2:
                            label_of[near] = count
                            waiting[left] = near
                            left += 1
        count += 1
    labels = np.empty_like(cells)
    for i in range(len(cells)):
        labels[i] = label_of[cells[i]]
    return labels, count


@numba.njit(**INLINED)
def _directions(poses: NDArray[np.float64], sines: NDArray[np.float32], cosines: NDArray[np.float32]) -> None:
    for i in range(len(poses)):
        sines[i], cosines[i] = sine_cosine(F(poses[i, 2]))


@numba.njit(**_OPTIONS)
def moments_of(
    poses: NDArray[np.float64], weights: NDArray[np.float64], labels: NDArray[np.int64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Mass (M,), mean (M, 3) and covariance (M, 3, 3) of each cluster; one of next to no weight gets equal weights."""
    mass, number = np.zeros(count), np.zeros(count)
    for i in range(len(poses)):
        mass[labels[i]] += weights[i]
        number[labels[i]] += 1.0
    sums, per_mass, each = np.zeros((count, 4)), np.zeros(count), np.zeros(count)
    for m in range(count):
        if mass[m] > _LEAST_MASS:
            per_mass[m] = 1.0 / mass[m]
        else:
            each[m] = 1.0 / number[m]
    sines, cosines = np.empty(len(poses), np.float32), np.empty(len(poses), np.float32)
    _directions(poses, sines, cosines)
    for i in range(len(poses)):
        m = labels[i]
        share = weights[i] * per_mass[m] + each[m]
        sums[m, 0] += share * poses[i, 0]
        sums[m, 1] += share * poses[i, 1]
        sums[m, 2] += share * cosines[i]
        sums[m, 3] += share * sines[i]
    means, covariances = np.empty((count, 3)), np.zeros((count, 3, 3))
    for m in range(count):
        yaw = np.arctan2(sums[m, 3], sums[m, 2])
        means[m, 0], means[m, 1], means[m, 2] = sums[m, 0], sums[m, 1], -np.pi if yaw >= np.pi else yaw
    residual = np.empty(3)
    for i in range(len(poses)):
        m = labels[i]
        share = weights[i] * per_mass[m] + each[m]
        for axis in range(3):
            residual[axis] = poses[i, axis] - means[m, axis]
        residual[2] -= 2.0 * np.pi * np.floor((residual[2] + np.pi) / (2.0 * np.pi))
        for a in range(3):
            weighed = share * residual[a]
            for b in range(a + 1):
                covariances[m, a, b] += weighed * residual[b]
    for m in range(count):
        for a in range(3):
            for b in range(a):
                covariances[m, b, a] = covariances[m, a, b]
    return mass, means, covariances


@numba.njit(**_OPTIONS)
def spread_in_clusters(
    poses: NDArray[np.float64],
    labels: NDArray[np.int64],
    means: NDArray[np.float64],
    roots: NDArray[np.float64],
    widths: NDArray[np.float64],
    key: NDArray[np.uint32],
) -> NDArray[np.float64]:
    """Poses (N, 3) drawn towards their cluster's mean, with kernel noise of `widths` (M,) times its root (M, 3, 3).

    The noise is that of `fusion.kernels.random` with this key (4,), counted by particle.
    """
    moved, noise = np.empty_like(poses), np.empty(SCRATCH_SIZE, np.float32)
    shrink = np.sqrt(1.0 - widths * widths)
    for start in range(0, len(poses), BLOCK):
        count = min(BLOCK, len(poses) - start)
        three_normals(start, count, np.uint32(0), MOTION_STREAM, key, E0, noise)
        for j in range(count):
            i = start + j
            m = labels[i]
            for axis in range(3):
                residual = poses[i, axis] - means[m, axis]
                if axis == 2:
                    residual -= 2.0 * np.pi * np.floor((residual + np.pi) / (2.0 * np.pi))
                kick = roots[m, axis, 0] * noise[E0 + j] + roots[m, axis, 1] * noise[E1 + j]
                kick += roots[m, axis, 2] * noise[E2 + j]
                moved[i, axis] = means[m, axis] + shrink[m] * residual + widths[m] * kick
            yaw = moved[i, 2] - 2.0 * np.pi * np.floor((moved[i, 2] + np.pi) / (2.0 * np.pi))
            moved[i, 2] = yaw if yaw < np.pi else -np.pi
    return moved
