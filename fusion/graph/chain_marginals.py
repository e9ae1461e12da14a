"""Marginal covariances of a chain from its Bayes net, backward: each pose given the next one.

Source: Golub, Plemmons, "Large-scale geodetic least-squares adjustment by dissection and orthogonal decomposition",
1980; Kaess, Dellaert, "Covariance recovery from a square root information matrix for data association", 2009.
"""

from collections.abc import Sequence

import gtsam
import numba
import numpy as np
from numpy.typing import NDArray

from fusion.arrays import FloatArray


def chain_covariances(bayes_net: gtsam.GaussianBayesNet) -> FloatArray:
    """Covariances (N, d, d) of a chain that was eliminated from its first variable to its last."""
    conditionals: Sequence[gtsam.GaussianConditional] = [bayes_net.at(k) for k in range(bayes_net.size())]
    roots = np.array([conditional.R() for conditional in conditionals])
    links = np.zeros_like(roots)
    if len(conditionals) > 1:
        links[:-1] = [conditional.S() for conditional in conditionals[:-1]]
    covariances = np.empty_like(roots)
    _backward(roots, links, covariances)
    return covariances


@numba.njit(cache=True, nogil=True)
def _backward(
    roots: NDArray[np.float64], links: NDArray[np.float64], covariances: NDArray[np.float64]
) -> None:
    """``R_k x_k + S_k x_k+1 = d + e`` with unit errors e: ``C_k = R^-1 (1 + S C_k+1 S^T) R^-T``; R upper triangular."""
    count, size = roots.shape[0], roots.shape[1]
    noise, inverse = np.empty((size, size)), np.empty((size, size))
    half = np.empty((size, size))
    for k in range(count - 1, -1, -1):
        root, link = roots[k], links[k]
        for j in range(size):
            for i in range(size):
                inverse[i, j] = 0.0
            for i in range(j, -1, -1):
                total = 1.0 if i == j else 0.0
                for m in range(i + 1, j + 1):
                    total -= root[i, m] * inverse[m, j]
                inverse[i, j] = total / root[i, i]
        for i in range(size):
            for j in range(size):
                noise[i, j] = 1.0 if i == j else 0.0
        if k < count - 1:
            after = covariances[k + 1]
            for i in range(size):
                for j in range(size):
                    total = 0.0
                    for m in range(size):
                        total += link[i, m] * after[m, j]
                    half[i, j] = total
            for i in range(size):
                for j in range(size):
                    total = 0.0
                    for m in range(size):
                        total += half[i, m] * link[j, m]
                    noise[i, j] += total
        for i in range(size):
            for j in range(size):
                total = 0.0
                for m in range(size):
                    total += inverse[i, m] * noise[m, j]
                half[i, j] = total
        for i in range(size):
            for j in range(size):
                total = 0.0
                for m in range(size):
                    total += half[i, m] * inverse[j, m]
                covariances[k, i, j] = total
