"""PoseGraph: the factors that are not measurements of the map, and damped Gauss-Newton steps with those that are.

GTSAM linearises its own factors and solves; the measurements come as quadratics, one Hessian factor a node, and an
odometry that is to be calibrated as Jacobian factors, so that no callback from GTSAM into Python is ever made.
"""

import gtsam
import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.graph.calibration_walk import CalibrationWalk
from fusion.graph.chain_marginals import chain_covariances
from fusion.graph.covariances import positive_definite, turned
from fusion.graph.sites import Sites
from fusion.graph.solution import HALVINGS, Solution, is_no_worse


class PoseGraph:
    """A chain of N poses, keys 0 to N - 1, with whatever else binds them.

    Parameters
    ----------
    graph : gtsam.NonlinearFactorGraph
        All factors but the measurements' and those in `walk`.
    count : int
        N.
    is_chain : bool
        Whether every factor stands on one pose or on two neighbours.
    walk : CalibrationWalk, optional
        The odometry and its calibrations, keys N to N + S - 1, when it is to be calibrated.
    """

    def __init__(
        self, graph: gtsam.NonlinearFactorGraph, count: int, is_chain: bool, walk: CalibrationWalk | None = None
    ) -> None:
        self._graph, self._count, self._is_chain, self._walk = graph, count, is_chain, walk
        keys = np.arange(count) if walk is None else walk.elimination_order()
        self._keys, self._order, self._slots = keys, gtsam.Ordering(), (keys >= count).astype(np.int64)
        for key in keys.tolist():
            self._order.push_back(key)

    def at(self, poses: FloatArray, nodes: IntArray, sites: Sites) -> Solution:
        """The graph at poses (N, 3), before any step."""
        calibrations = np.zeros((0 if self._walk is None else self._walk.count, 3))
        cost = self._cost(_values(poses), poses, calibrations, nodes, sites)
        return Solution(poses, calibrations, None, None, cost, 0.0)

    def step(self, before: Solution, nodes: IntArray, sites: Sites, marginals: bool = True) -> Solution:
        """A Gauss-Newton step, halved until the cost does not grow.

        Raises
        ------
        SkyfixError
            When the graph cannot be solved or the solution is not finite.
        """
        given = _values(before.poses)
        linear = self._linearised(given, before, nodes, sites)
        try:
            bayes_net = self._eliminated(linear)
            delta = bayes_net.optimize()
            covariances = self._covariances(linear, bayes_net, before) if marginals else None
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[0]
            raise SkyfixError(f"smoother: expected a solvable graph, got {reason}") from error
        keys = range(self._count, self._count + len(before.calibrations))
        turns = np.array([delta.at(key) for key in keys]).reshape(-1, 3)
        cost = self._cost(given, before.poses, before.calibrations, nodes, sites)
        poses, calibrations, reached = before.poses, before.calibrations, np.inf
        for halving in range(HALVINGS):
            values = given.retract(delta.scale(0.5**halving))
            poses = np.array(gtsam.utilities.extractPose2(values)).reshape(-1, 3)
            calibrations = before.calibrations + 0.5**halving * turns
            reached = self._cost(values, poses, calibrations, nodes, sites)
            if is_no_worse(reached, cost):
                break
        finite = np.isfinite(reached) and np.isfinite(poses).all()
        if not finite or (covariances is not None and not np.isfinite(covariances).all()):
            raise SkyfixError("smoother: expected a finite solution, got NaN or an infinity")
        half_log_det = float(bayes_net.logDeterminant())
        if covariances is None:
            return Solution(poses, calibrations, None, None, reached, half_log_det)
        own = positive_definite(turned(covariances[: self._count], before.poses[:, 2]))
        return Solution(poses, calibrations, own, covariances[self._count :], reached, half_log_det)

    def _linearised(
        self, values: gtsam.Values, at: Solution, nodes: IntArray, sites: Sites
    ) -> gtsam.GaussianFactorGraph:
        linear = self._graph.linearize(values)
        own = sites.about(at.poses[nodes])
        turn = se2.rotation(at.poses[nodes, 2])
        back = turn.swapaxes(1, 2)
        precision = back @ own.precision @ turn
        information = np.einsum("mij,mj->mi", back, own.information)
        for node, matrix, vector in zip(nodes.tolist(), precision, information, strict=True):
            linear.push_back(gtsam.HessianFactor(node, matrix, vector, 0.0))
        if self._walk is not None:
            self._walk.add_to(linear, at.poses, at.calibrations)
        return linear

    def _eliminated(self, linear: gtsam.GaussianFactorGraph) -> gtsam.GaussianBayesNet:
        if self._is_chain:
            return linear.eliminateSequential(self._order)
        return linear.eliminateSequential()  # loops want another order, GTSAM's own

    def _cost(
        self, values: gtsam.Values, poses: FloatArray, calibrations: FloatArray, nodes: IntArray, sites: Sites
    ) -> float:
        walked = 0.0 if self._walk is None else self._walk.cost(poses, calibrations)
        return float(self._graph.error(values)) + float(sites.costs(poses[nodes]).sum()) + walked

    def _covariances(
        self, linear: gtsam.GaussianFactorGraph, bayes_net: gtsam.GaussianBayesNet, at: Solution
    ) -> FloatArray:
        """In the order of the keys, poses on the axes of the body."""
        size = self._count + len(at.calibrations)
        if not self._is_chain:
            marginals = gtsam.Marginals(linear, bayes_net.optimize())
            return np.array([marginals.marginalCovariance(key) for key in range(size)])
        found = np.empty((size, 3, 3))
        found[self._keys] = chain_covariances(bayes_net, self._slots)
        return found


def _values(poses: FloatArray) -> gtsam.Values:
    values = gtsam.Values()
    for node, (x, y, yaw) in enumerate(poses.tolist()):
        values.insert(node, gtsam.Pose2(x, y, yaw))
    return values
