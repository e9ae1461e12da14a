"""From the motions of a drive to the graph that a smoother solves."""

from collections.abc import Sequence

import gtsam
import numpy as np

from fusion.graph.calibration_walk import CalibrationWalk
from fusion.graph.chain import Chain
from fusion.graph.chain_graph import ChainGraph
from fusion.graph.covariances import noises_of, positive_definite
from fusion.graph.inverses import inverses
from fusion.graph.odometry_factors import CalibratedOdometry
from fusion.graph.plain_odometry import PlainOdometry
from fusion.graph.pose_graph import PoseGraph
from fusion.graph.smoother_settings import SmootherSettings
from fusion.graph.solution import SteppedGraph
from fusion.prior import UniformPrior


def pose_graph(
    chain: Chain,
    prior: UniformPrior,
    settings: SmootherSettings,
    others: Sequence[gtsam.NonlinearFactor] = (),
) -> SteppedGraph:
    """Prior, odometry and `others`: without any, a chain that needs no GTSAM.

    Parameters
    ----------
    others : sequence of gtsam.NonlinearFactor
        Absolute factors, loop closures; on keys 0 to N - 1.
    """
    if others or settings.odometry_kernel == "dcs":
        return gtsam_graph(chain, prior, settings, others)
    first = PlainOdometry.of(prior.mean[None], prior.covariance[None], np.inf)
    walk = _walk(chain, settings)
    motions = walk or PlainOdometry.of(chain.deltas, chain.covariances, _huber_width(settings))
    return ChainGraph(first, motions, len(chain.deltas) + 1)


def gtsam_graph(
    chain: Chain,
    prior: UniformPrior,
    settings: SmootherSettings,
    others: Sequence[gtsam.NonlinearFactor] = (),
) -> PoseGraph:
    """As `pose_graph`, of GTSAM's factors."""
    count = len(chain.deltas) + 1
    graph = gtsam.NonlinearFactorGraph()
    [first] = noises_of(prior.covariance[None], prior.mean[None, 2])
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*prior.mean), first))
    for factor in others:
        graph.push_back(factor)
    is_chain = all(np.ptp(list(factor.keys())) <= 1 for factor in others)
    walk = _walk(chain, settings)
    if walk is not None:
        return PoseGraph(graph, count, is_chain, walk)
    noises: list[gtsam.noiseModel.Base] = [*noises_of(chain.covariances, chain.deltas[:, 2])]
    width, kernels = settings.odometry_kernel_width, gtsam.noiseModel.mEstimator
    if settings.odometry_kernel != "none":
        kernel = kernels.Huber.Create(width) if settings.odometry_kernel == "huber" else kernels.DCS.Create(width)
        noises = [gtsam.noiseModel.Robust.Create(kernel, noise) for noise in noises]
    for node, ((x, y, yaw), noise) in enumerate(zip(chain.deltas.tolist(), noises, strict=True)):
        graph.add(gtsam.BetweenFactorPose2(node, node + 1, gtsam.Pose2(x, y, yaw), noise))
    return PoseGraph(graph, count, is_chain)


def _walk(chain: Chain, settings: SmootherSettings) -> CalibrationWalk | None:
    """The odometry with its calibrations, when there are any."""
    drift = settings.drift
    if drift is None or len(chain.deltas) == 0:
        return None
    own = np.asarray(np.linalg.cholesky(positive_definite(chain.covariances)), dtype=np.float64)
    odometry = CalibratedOdometry(chain.deltas, inverses(own), drift.stretches(chain.deltas), _huber_width(settings))
    return CalibrationWalk(odometry, drift.first_sigmas, drift.step_sigmas)


def _huber_width(settings: SmootherSettings) -> float:
    return np.inf if settings.odometry_kernel == "none" else settings.odometry_kernel_width
