"""Which mode of each measurement is right, or none: the discrete half of the smoother.

Every node k has hypotheses h with weight w_h, mean m_h and covariance S_h, and a null hypothesis with the outlier
probability p and the clutter density. They are compared by the evidence that the *rest* of the graph gives them,

    (1 - p) w_h N(m_h; x_k, S_h + P_k)    against    p clutter,

where (x_k, P_k) is the marginal of node k with its own chosen measurement taken out again (the cavity). Judging a
mode at the smoothed pose itself would reject every mode that the current estimate is not yet drawn to.

Source: Olson, Agarwal, "Inference on networks of mixtures for robust robot mapping", RSS 2012 (max-mixture, null
hypothesis); Minka, "Expectation propagation", 2001 (cavity).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.gaussian_mixture import GaussianMixture

REJECTED = -1
NOT_MEASURED = -2
_LEAST_INFORMATION = 1e-9  # of a cavity that only the removed measurement held: 30 km


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """The modes of all measurements in one list, H in all, grouped by node.

    Parameters
    ----------
    node_count : int
        Number N of nodes.
    node, mode : (H,) int64
        Node of each hypothesis, and its index in that node's mixture.
    log_weights : (H,) float64
        ln of the mode's mass.
    means : (H, 3) float64
        Map frame.
    covariances : (H, 3, 3) float64
        On the axes of the map.
    """

    node_count: int
    node: IntArray
    mode: IntArray
    log_weights: FloatArray
    means: FloatArray
    covariances: FloatArray

    @classmethod
    def of(cls, measurements: Sequence[GaussianMixture | None]) -> "Hypotheses":
        """Collect the modes of one measurement, or none, a node."""
        mixtures = [(node, mixture) for node, mixture in enumerate(measurements) if mixture is not None]
        return cls(
            len(measurements),
            np.array([node for node, mixture in mixtures for _ in mixture.weights], dtype=np.int64),
            np.array([mode for _, mixture in mixtures for mode in range(len(mixture))], dtype=np.int64),
            np.log([weight for _, mixture in mixtures for weight in mixture.weights]),
            np.concatenate([np.empty((0, 3)), *(mixture.means for _, mixture in mixtures)]),
            np.concatenate([np.empty((0, 3, 3)), *(mixture.covariances for _, mixture in mixtures)]),
        )

    def chosen_rows(self, choice: IntArray) -> IntArray:
        """Rows of the hypotheses that `choice` (N,) names."""
        return np.flatnonzero(choice[self.node] == self.mode)

    def cavities(self, poses: FloatArray, covariances: FloatArray, choice: IntArray) -> tuple[FloatArray, FloatArray]:
        """Marginals (N, 3), (N, 3, 3) of the nodes with the measurements in `choice` (N,) taken out of them."""
        rows = self.chosen_rows(choice)
        nodes = self.node[rows]
        removed = np.linalg.inv(self.covariances[rows])
        values, vectors = np.linalg.eigh(np.linalg.inv(covariances[nodes]) - removed)
        values = np.maximum(values, _LEAST_INFORMATION)
        cavity = (vectors / values[:, None, :]) @ vectors.swapaxes(1, 2)
        residual = self.means[rows] - poses[nodes]
        residual[:, 2] = se2.wrap(residual[:, 2])
        poses, covariances = poses.copy(), covariances.copy()
        poses[nodes] -= np.einsum("nij,njk,nk->ni", cavity, removed, residual)
        covariances[nodes] = cavity
        return poses, covariances

    def choose(
        self, poses: FloatArray, covariances: FloatArray, outlier_probability: float, clutter_log_density: float
    ) -> IntArray:
        """Best mode of each node (N,), REJECTED or NOT_MEASURED, given cavities (N, 3) and (N, 3, 3)."""
        choice = np.full(self.node_count, NOT_MEASURED, dtype=np.int64)
        choice[self.node] = REJECTED
        residual = self.means - poses[self.node]
        residual[:, 2] = se2.wrap(residual[:, 2])
        spread = self.covariances + covariances[self.node]
        root = np.linalg.cholesky(spread)
        white = np.linalg.solve(root, residual[..., None])[..., 0]
        log_det = 2.0 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        log_evidence = -0.5 * ((white**2).sum(axis=1) + log_det + 3.0 * np.log(se2.TWO_PI))
        score = np.log1p(-outlier_probability) + self.log_weights + log_evidence
        order = np.argsort(score, kind="stable")  # the best of each node is written last
        order = order[score[order] > np.log(outlier_probability) + clutter_log_density]
        choice[self.node[order]] = self.mode[order]
        return choice
