"""Marginal covariances of a chain from its Bayes net, backward: each variable given the ones after it.

A conditional says ``R x + S y = d + e`` with unit errors e, so that with the covariance J of what comes after

    cov(x) = R^-1 (1 + S J S^T) R^-T,    cov(x, y) = -R^-1 S J.

In a chain of poses with calibrations the variables after are never more than one pose and one calibration: two slots.

Source: Kaess, Dellaert, "Covariance recovery from a square root information matrix for data association", 2009.
"""

import gtsam
import numba
import numpy as np
from numpy.typing import NDArray

from fusion.arrays import FloatArray, IntArray
from fusion.graph.chain_elimination import WIDTH


def chain_covariances(bayes_net: gtsam.GaussianBayesNet, slots: IntArray) -> FloatArray:
    """Covariances (V, 3, 3) of the variables in the order in which they were eliminated.

    Parameters
    ----------
    bayes_net : gtsam.GaussianBayesNet
        Of V variables of 3 dimensions.
    slots : (V,) int64
        0 for a pose, 1 for a calibration; a conditional's parents are the nearest pose after it, and, where there are
        any, the nearest calibration.
    """
    roots = np.empty((len(slots), 3, 3))
    links = np.zeros((len(slots), 3, WIDTH))
    for k in range(len(slots)):
        conditional = bayes_net.at(k)
        roots[k] = conditional.R()
        link = conditional.S()
        links[k, :, : link.shape[1]] = link
    covariances = np.empty_like(roots)
    covariances_back(roots, links, slots, covariances)
    return covariances


@numba.njit(cache=True, nogil=True)
def covariances_back(
    roots: NDArray[np.float64], links: NDArray[np.float64], slots: NDArray[np.int64], covariances: NDArray[np.float64]
) -> None:
    """Write the covariances (V, 3, 3) of variables with the roots R (V, 3, 3) and the links S (V, 3, 6)."""
    joint = np.zeros((WIDTH, WIDTH))  # of the nearest pose and calibration after
    inverse, gain = np.zeros((3, 3)), np.empty((3, WIDTH))
    cross = np.empty((3, WIDTH))
    for k in range(len(roots) - 1, -1, -1):
        root = roots[k]
        for j in range(3):
            for i in range(j, -1, -1):
                total = 1.0 if i == j else 0.0
                for m in range(i + 1, j + 1):
                    total -= root[i, m] * inverse[m, j]
                inverse[i, j] = total / root[i, i]
        for i in range(3):
            for j in range(WIDTH):
                total = 0.0
                for m in range(i, 3):
                    total -= inverse[i, m] * links[k, m, j]
                gain[i, j] = total
        for i in range(3):
            for j in range(WIDTH):
                total = 0.0
                for m in range(WIDTH):
                    total += gain[i, m] * joint[m, j]
                cross[i, j] = total
        for i in range(3):
            for j in range(3):
                total = 0.0
                for m in range(3):
                    total += inverse[i, m] * inverse[j, m]
                for m in range(WIDTH):
                    total += cross[i, m] * gain[j, m]
                covariances[k, i, j] = total
        begin = 3 * slots[k]
        for i in range(3):
            for j in range(WIDTH):
                joint[begin + i, j] = cross[i, j]
                joint[j, begin + i] = cross[i, j]
        for i in range(3):
            for j in range(3):
                joint[begin + i, begin + j] = covariances[k, i, j]
