"""From the motions of a drive to the graph that a smoother solves."""

from collections.abc import Sequence

import gtsam
import numpy as np

from fusion.graph.calibration_walk import CalibrationWalk
from fusion.graph.chain import Chain
from fusion.graph.covariances import noises_of, positive_definite
from fusion.graph.odometry_factors import CalibratedOdometry
from fusion.graph.pose_graph import PoseGraph
from fusion.graph.smoother_settings import SmootherSettings
from fusion.prior import UniformPrior


def pose_graph(
    chain: Chain,
    prior: UniformPrior,
    settings: SmootherSettings,
    others: Sequence[gtsam.NonlinearFactor] = (),
) -> PoseGraph:
    """Prior, odometry and `others`, on keys 0 to N - 1.

    Parameters
    ----------
    others : sequence of gtsam.NonlinearFactor
        Absolute factors, loop closures.
    """
    count = len(chain.deltas) + 1
    graph = gtsam.NonlinearFactorGraph()
    [first] = noises_of(prior.covariance[None], prior.mean[None, 2])
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*prior.mean), first))
    for factor in others:
        graph.push_back(factor)
    is_chain = all(np.ptp(list(factor.keys())) <= 1 for factor in others)
    drift = settings.drift
    if drift is not None and count > 1:
        roots = np.linalg.inv(np.linalg.cholesky(positive_definite(chain.covariances)))
        width = np.inf if settings.odometry_kernel == "none" else settings.odometry_kernel_width
        odometry = CalibratedOdometry(chain.deltas, roots, drift.stretches(chain.deltas), width)
        walk = CalibrationWalk(odometry, drift.first_sigmas, drift.step_sigmas)
        return PoseGraph(graph, count, is_chain, walk)
    noises: list[gtsam.noiseModel.Base] = [*noises_of(chain.covariances, chain.deltas[:, 2])]
    width, kernels = settings.odometry_kernel_width, gtsam.noiseModel.mEstimator
    if settings.odometry_kernel != "none":
        kernel = kernels.Huber.Create(width) if settings.odometry_kernel == "huber" else kernels.DCS.Create(width)
        noises = [gtsam.noiseModel.Robust.Create(kernel, noise) for noise in noises]
    for node, ((x, y, yaw), noise) in enumerate(zip(chain.deltas.tolist(), noises, strict=True)):
        graph.add(gtsam.BetweenFactorPose2(node, node + 1, gtsam.Pose2(x, y, yaw), noise))
    return PoseGraph(graph, count, is_chain)
