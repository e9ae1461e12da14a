"""Map likelihoods in a GTSAM graph of your own: poses in space (Pose3), odometry, heights, and whole likelihoods.

Everything here is emulated: the vehicle on a hill, its drifting odometry, and likelihoods with two streets in them.

    python examples/gtsam_graph.py
"""

from __future__ import annotations

import gtsam
import numpy as np

from fusion import GaussianMixture, LikelihoodFactors, se2

COUNT, ROUNDS = 40, 4
SEEN = np.diag([0.8, 0.6, 0.03]) ** 2
STREETS_APART_M = 25.0


def main() -> None:
    """Solve the graph with and without the likelihoods, and say how far off each is."""
    rng = np.random.default_rng(0)
    step = np.array([0.0, 0.0, 0.04, 3.0, 0.0, 0.0])  # roll, pitch, yaw, forward, left, up
    drift = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.002, 0.002, 0.01, 0.15, 0.1, 0.05]))
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    first = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.05, 0.05, 0.1, 3.0, 3.0, 3.0]))
    truth = [gtsam.Pose3()]
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), first))
    start.insert(0, gtsam.Pose3(gtsam.Rot3.Yaw(0.05), np.array([2.0, -2.0, 0.0])))
    for node in range(1, COUNT):
        truth.append(truth[-1].compose(gtsam.Pose3.Expmap(step)))
        told = gtsam.Pose3.Expmap(step + rng.normal(0.0, drift.sigmas()))
        graph.add(gtsam.BetweenFactorPose3(node - 1, node, told, drift))
        start.insert(node, start.atPose3(node - 1).compose(told))

    keys, measurements = list(range(0, COUNT, 2)), []
    for key in keys:
        pose = truth[key]
        right = np.array([pose.x(), pose.y(), pose.rotation().yaw()]) + rng.multivariate_normal(np.zeros(3), SEEN)
        wrong = se2.compose(right, np.array([0.0, STREETS_APART_M, 0.0]))
        weights = np.array([0.5, 0.5]) if key % 4 else np.array([0.4, 0.6])
        measurements.append(GaussianMixture(weights, np.array([right, wrong]), np.array([SEEN, SEEN])))

    likelihoods = LikelihoodFactors(keys, measurements)
    values, covariances = start, [np.diag([0.01, 0.01, 0.1, 5.0, 5.0, 3.0]) ** 2] * len(keys)
    for _ in range(ROUNDS):
        whole = gtsam.NonlinearFactorGraph(graph)
        for factor in likelihoods.at(values, covariances):
            whole.push_back(factor)
        values = gtsam.LevenbergMarquardtOptimizer(whole, values).optimize()
        marginals = gtsam.Marginals(whole, values)
        covariances = [marginals.marginalCovariance(key) for key in keys]

    def off(found: gtsam.Values) -> float:
        gaps = [found.atPose3(k).translation()[:2] - truth[k].translation()[:2] for k in range(COUNT)]
        return float(np.linalg.norm(gaps, axis=1).mean())

    alone = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    print(f"emulated drive of {COUNT} poses in space, mean error: odometry {off(alone):.2f} m, map {off(values):.2f} m")


if __name__ == "__main__":
    main()
