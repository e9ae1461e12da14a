"""A chain of poses, with calibrations or without, solved by eliminating its variables in order: one compiled pass.

What has been eliminated leaves a message, the information (6, 6) on the next pose and the present calibration. With the
factors of the next variable it makes a front; the variable's block has a root R with ``R^T R`` equal to it, and

    R x + S y = d,    S = R^-T B,    d = R^-T v,    message' = rest - S^T S

with B the front's rows to the variables y that stay. The same as GTSAM's elimination of the same graph in this order.

Source: Dellaert, Kaess, "Factor graphs for robot perception", Foundations and Trends in Robotics, 2017, chapter 3.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.graph.chain_algebra import OPTIONS

WIDTH = 6  # of what a conditional's parents have: the nearest pose after it, the nearest calibration


@numba.njit(**OPTIONS)
def _eliminate_first(
    front: NDArray[np.float64],
    vector: NDArray[np.float64],
    root: NDArray[np.float64],
    link: NDArray[np.float64],
    value: NDArray[np.float64],
    message: NDArray[np.float64],
    left: NDArray[np.float64],
) -> float:
    """Eliminate the first variable of a front (9, 9) with a vector (9,).

    Written: R, S, d, and the message with its vector. Returns ln of the determinant of R, NaN where it has none.
    """
    r00 = np.sqrt(front[0, 0])
    r01, r02 = front[0, 1] / r00, front[0, 2] / r00
    r11 = np.sqrt(front[1, 1] - r01 * r01)
    r12 = (front[1, 2] - r01 * r02) / r11
    r22 = np.sqrt(front[2, 2] - r02 * r02 - r12 * r12)
    root[0, 0], root[0, 1], root[0, 2] = r00, r01, r02
    root[1, 0], root[1, 1], root[1, 2] = 0.0, r11, r12
    root[2, 0], root[2, 1], root[2, 2] = 0.0, 0.0, r22
    for j in range(WIDTH):
        link[0, j] = front[0, 3 + j] / r00
        link[1, j] = (front[1, 3 + j] - r01 * link[0, j]) / r11
        link[2, j] = (front[2, 3 + j] - r02 * link[0, j] - r12 * link[1, j]) / r22
    value[0] = vector[0] / r00
    value[1] = (vector[1] - r01 * value[0]) / r11
    value[2] = (vector[2] - r02 * value[0] - r12 * value[1]) / r22
    for i in range(WIDTH):
        left[i] = vector[3 + i] - link[0, i] * value[0] - link[1, i] * value[1] - link[2, i] * value[2]
        for j in range(WIDTH):
            square = link[0, i] * link[0, j] + link[1, i] * link[1, j] + link[2, i] * link[2, j]
            message[i, j] = front[3 + i, 3 + j] - square
    return float(np.log(r00 * r11 * r22))


@numba.njit(**OPTIONS)
def eliminate_chain(
    firsts: NDArray[np.float64],
    seconds: NDArray[np.float64],
    owns: NDArray[np.float64],
    rights: NDArray[np.float64],
    stretch: NDArray[np.int64],
    message: NDArray[np.float64],
    left: NDArray[np.float64],
    precisions: NDArray[np.float64],
    informations: NDArray[np.float64],
    step_precision: NDArray[np.float64],
    calibration_steps: NDArray[np.float64],
    roots: NDArray[np.float64],
    links: NDArray[np.float64],
    values: NDArray[np.float64],
) -> float:
    """Eliminate each pose, and each calibration after the last pose whose motion it belongs to.

    Parameters
    ----------
    firsts, seconds, owns, rights : (N - 1, 3, 3), (N - 1, 3, 3), (N - 1, 3, 3 or 0), (N - 1, 3) float64
        Whitened derivatives of the motions by their poses and their calibration, and right-hand sides.
    stretch : (N - 1,) int64
        Calibration of each motion.
    message, left : (6, 6), (6,) float64
        Information on the first pose and the first calibration, and its vector; overwritten.
    precisions, informations : (N, 3, 3), (N, 3) float64
        Quadratics on the poses.
    step_precision : (3,) float64
        Of the differences between neighbouring calibrations.
    calibration_steps : (S - 1, 3) float64
        These differences at present.
    roots, links, values : (V, 3, 3), (V, 3, 6), (V, 3) float64
        Written: R, S and d of every variable, V = N + S, in the order of elimination.

    Returns
    -------
    float
        Half ln of the determinant of the information; NaN when it is not positive definite.
    """
    calibrated = owns.shape[2] == 3
    width = 9 if calibrated else 6
    jacobian, front, vector = np.zeros((3, 9)), np.zeros((9, 9)), np.zeros(9)
    log_det, row, last = 0.0, 0, len(precisions) - 1
    for k in range(last + 1):
        front[:], vector[:] = 0.0, 0.0
        if k < last:
            for i in range(3):
                for j in range(3):
                    jacobian[i, j], jacobian[i, 3 + j] = firsts[k, i, j], seconds[k, i, j]
                    if calibrated:
                        jacobian[i, 6 + j] = owns[k, i, j]
            for i in range(width):
                a, b, c = jacobian[0, i], jacobian[1, i], jacobian[2, i]
                vector[i] = a * rights[k, 0] + b * rights[k, 1] + c * rights[k, 2]
                for j in range(width):
                    front[i, j] = a * jacobian[0, j] + b * jacobian[1, j] + c * jacobian[2, j]
        for i in range(3):
            vector[i] += left[i] + informations[k, i]
            vector[6 + i] += left[3 + i]
            for j in range(3):
                front[i, j] += message[i, j] + precisions[k, i, j]
                front[i, 6 + j] += message[i, 3 + j]
                front[6 + i, j] += message[3 + i, j]
                front[6 + i, 6 + j] += message[3 + i, 3 + j]
        log_det += _eliminate_first(front, vector, roots[row], links[row], values[row], message, left)
        row += 1
        ends = k == last - 1 or (k < last and stretch[k + 1] != stretch[k])
        if calibrated and ends:
            front[:], vector[:] = 0.0, 0.0
            for i in range(3):
                vector[i], vector[3 + i] = left[3 + i], left[i]
                for j in range(3):
                    front[i, j], front[i, 3 + j] = message[3 + i, 3 + j], message[3 + i, j]
                    front[3 + i, j], front[3 + i, 3 + j] = message[i, 3 + j], message[i, j]
                if k < last - 1:
                    weight = step_precision[i]
                    pull = weight * calibration_steps[stretch[k], i]
                    front[i, i] += weight
                    front[i, 6 + i], front[6 + i, i], front[6 + i, 6 + i] = -weight, -weight, weight
                    vector[i] += pull
                    vector[6 + i] -= pull
            log_det += _eliminate_first(front, vector, roots[row], links[row], values[row], message, left)
            row += 1
    return log_det


@numba.njit(**OPTIONS)
def substitute_back(
    roots: NDArray[np.float64],
    links: NDArray[np.float64],
    values: NDArray[np.float64],
    slots: NDArray[np.int64],
    found: NDArray[np.float64],
) -> None:
    """The solution (V, 3) of what was eliminated, backward; `slots` as for `fusion.graph.chain_marginals`."""
    after, part = np.zeros(WIDTH), np.empty(3)
    for k in range(len(roots) - 1, -1, -1):
        for i in range(2, -1, -1):
            total = values[k, i]
            for j in range(WIDTH):
                total -= links[k, i, j] * after[j]
            for j in range(i + 1, 3):
                total -= roots[k, i, j] * part[j]
            part[i] = total / roots[k, i, i]
        for i in range(3):
            after[3 * slots[k] + i] = found[k, i] = part[i]
