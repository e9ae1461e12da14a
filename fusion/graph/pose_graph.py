"""PoseGraph: the factors that are not measurements of the map, and damped Gauss-Newton steps with those that are.

GTSAM linearises and solves; the measurements come as quadratics, one Hessian factor a node, so that no callback from
GTSAM into Python is ever made.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.graph.chain_marginals import chain_covariances
from fusion.graph.covariances import positive_definite, turned
from fusion.graph.sites import Sites

_HALVINGS = 12
_SLACK = 1e-9  # of a cost, by which rounding may make a step look worse


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where a graph stands.

    Parameters
    ----------
    values : gtsam.Values
        Poses by node.
    poses : (N, 3) float64
        The same.
    covariances : (N, 3, 3) float64
        Marginals on the axes of the map, linearised one step before `poses`; None when they were not asked for.
    cost : float
        Minus the log posterior density at the poses, up to a constant.
    half_log_det : float
        Half ln of the determinant of the information.
    """

    values: gtsam.Values
    poses: FloatArray
    covariances: FloatArray | None
    cost: float
    half_log_det: float


class PoseGraph:
    """A chain of N poses, keys 0 to N - 1, with whatever else binds them.

    Parameters
    ----------
    graph : gtsam.NonlinearFactorGraph
        All factors but the measurements'.
    count : int
        N.
    is_chain : bool
        Whether every factor stands on one pose or on two neighbours.
    """

    def __init__(self, graph: gtsam.NonlinearFactorGraph, count: int, is_chain: bool) -> None:
        self._graph, self._count, self._is_chain = graph, count, is_chain
        self._order = gtsam.Ordering()
        for node in range(count):
            self._order.push_back(node)

    def at(self, poses: FloatArray, nodes: IntArray, sites: Sites) -> Solution:
        """The graph at poses (N, 3), before any step."""
        values = gtsam.Values()
        for node, (x, y, yaw) in enumerate(poses.tolist()):
            values.insert(node, gtsam.Pose2(x, y, yaw))
        return Solution(values, poses, None, self._cost(values, poses, nodes, sites), 0.0)

    def step(self, before: Solution, nodes: IntArray, sites: Sites, marginals: bool = True) -> Solution:
        """A Gauss-Newton step, halved until the cost does not grow.

        Raises
        ------
        SkyfixError
            When the graph cannot be solved or the solution is not finite.
        """
        linear = self._graph.linearize(before.values)
        own = sites.about(before.poses[nodes])
        turn = se2.rotation(before.poses[nodes, 2])
        back = turn.swapaxes(1, 2)
        precision = back @ own.precision @ turn
        information = np.einsum("mij,mj->mi", back, own.information)
        for node, matrix, vector in zip(nodes.tolist(), precision, information, strict=True):
            linear.push_back(gtsam.HessianFactor(node, matrix, vector, 0.0))
        try:
            bayes_net = linear.eliminateSequential(self._order)
            delta = bayes_net.optimize()
            covariances = self._covariances(linear, bayes_net, before.values) if marginals else None
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[0]
            raise SkyfixError(f"smoother: expected a solvable graph, got {reason}") from error
        if covariances is not None:
            covariances = positive_definite(turned(covariances, before.poses[:, 2]))
        cost = self._cost(before.values, before.poses, nodes, sites)
        half_log_det = float(bayes_net.logDeterminant())
        values, poses, reached = before.values, before.poses, np.inf
        for halving in range(_HALVINGS):
            values = before.values.retract(delta.scale(0.5**halving))
            poses = np.array(gtsam.utilities.extractPose2(values)).reshape(-1, 3)
            reached = self._cost(values, poses, nodes, sites)
            if reached <= cost + _SLACK * (1.0 + abs(cost)):
                break
        finite = np.isfinite(reached) and np.isfinite(poses).all()
        if not finite or (covariances is not None and not np.isfinite(covariances).all()):
            raise SkyfixError("smoother: expected a finite solution, got NaN or an infinity")
        return Solution(values, poses, covariances, reached, half_log_det)

    def _cost(self, values: gtsam.Values, poses: FloatArray, nodes: IntArray, sites: Sites) -> float:
        return float(self._graph.error(values)) + float(sites.costs(poses[nodes]).sum())

    def _covariances(
        self, linear: gtsam.GaussianFactorGraph, bayes_net: gtsam.GaussianBayesNet, values: gtsam.Values
    ) -> FloatArray:
        if self._is_chain:
            return chain_covariances(bayes_net)
        marginals = gtsam.Marginals(linear, values)
        return np.array([marginals.marginalCovariance(node) for node in range(self._count)])
