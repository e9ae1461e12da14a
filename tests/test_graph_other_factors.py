"""Loop closures, absolute positions, and likelihoods in a GTSAM user's own graph."""

import gtsam
import numpy as np
import pytest

from fusion import (
    AbsoluteFix,
    GaussianMixture,
    LikelihoodFactors,
    LoopClosure,
    OdometryIncrement,
    SkyfixError,
    SmootherSettings,
    Trajectory,
    UniformPrior,
    se2,
    smooth,
)

SECOND = 1_000_000_000
STEP = np.diag([0.3, 0.2, 0.03]) ** 2
TIGHT = np.diag([0.05, 0.05, 0.01]) ** 2


def circle(count=40, seed=0):
    """A drive once around: stamps, increments, truth, what its odometry says, and its prior."""
    rng = np.random.default_rng(seed)
    truth, told = [np.zeros(3)], [np.zeros(3)]
    increments = []
    for node in range(1, count):
        delta = np.array([2.0, 0.0, 2.0 * np.pi / (count - 1)])
        truth.append(se2.compose(truth[-1], delta))
        delta = delta + rng.multivariate_normal(np.zeros(3), STEP)
        told.append(se2.compose(told[-1], delta))
        increments.append(OdometryIncrement(node * SECOND, delta, STEP))
    stamps = np.arange(count) * SECOND
    return stamps, increments, np.array(truth), Trajectory(stamps, np.array(told)), UniformPrior(np.zeros(3), 0.1, 0.02)


def mean_error(result, truth):
    return np.hypot(*(result.trajectory.poses - truth)[:, :2].T).mean()


def test_a_closed_loop_takes_the_drift_away_and_a_false_one_does_not_bend_it():
    stamps, increments, truth, start, prior = circle()
    nothing = [None] * len(stamps)
    right = LoopClosure(0, 39, se2.between(truth[0], truth[39]), TIGHT)
    false = LoopClosure(5, 30, np.zeros(3), TIGHT)
    open_, closed, both = (
        smooth(stamps, increments, nothing, prior, start, others=others) for others in ([], [right], [right, false])
    )
    assert mean_error(closed, truth) < 0.6 * mean_error(open_, truth)
    assert mean_error(both, truth) < 1.2 * mean_error(closed, truth)
    assert np.trace(closed.trajectory.covariances[39]) < 0.2 * np.trace(open_.trajectory.covariances[39])


def test_fixes_hold_a_drive_and_a_wrong_one_is_let_go():
    stamps, increments, truth, start, prior = circle(seed=1)
    spread = np.diag([0.5, 0.5]) ** 2
    fixes = [AbsoluteFix(node, truth[node, :2], spread) for node in range(4, 40, 5)]
    wrong = [*fixes, AbsoluteFix(21, truth[21, :2] + 30.0, spread)]
    nothing = [None] * len(stamps)
    free, held, misled = (
        smooth(stamps, increments, nothing, prior, start, others=others) for others in ([], fixes, wrong)
    )
    assert mean_error(held, truth) < 0.5
    assert mean_error(held, truth) < mean_error(free, truth)
    assert mean_error(misled, truth) < mean_error(held, truth) + 0.1


def test_the_wrong_closure_and_the_wrong_fix_are_told_by_their_weights():
    stamps, increments, truth, start, prior = circle(seed=2)
    spread, rng = np.diag([0.5, 0.4]) ** 2, np.random.default_rng(5)
    others = [LoopClosure(k, k + 30, se2.between(truth[k], truth[k + 30]), TIGHT) for k in (0, 4, 8)]
    others += [AbsoluteFix(k, truth[k, :2] + rng.multivariate_normal(np.zeros(2), spread), spread) for k in (5, 20, 35)]
    others[1:1] = [LoopClosure(6, 25, np.zeros(3), TIGHT)]
    others[5:5] = [AbsoluteFix(27, truth[27, :2] + [-15.0, 20.0], spread)]
    wrong = np.array([1, 5])
    result = smooth(stamps, increments, [None] * len(stamps), prior, start, others=others)
    assert result.other_residuals.shape == result.other_weights.shape == (8,)
    right = np.setdiff1d(np.arange(8), wrong)
    assert (result.other_weights[wrong] < 0.02).all()
    assert (result.other_weights[right] > 0.4).all()
    assert (result.other_residuals[wrong] > 20.0).all()
    assert (result.other_residuals[right] < 3.0).all()
    alone = smooth(stamps, increments, [None] * len(stamps), prior, start)
    assert alone.other_residuals.shape == alone.other_weights.shape == (0,)


def test_residuals_and_weights_are_those_of_the_factors_in_the_graph():
    """Loss of the residual is GTSAM's error; the weight is the loss's derivative by half the squared residual."""
    poses = np.array([[1.0, -2.0, 3.0], [4.0, 1.0, -2.9]])
    tilted = np.array([[0.9, 0.3, 0.02], [0.3, 0.5, -0.03], [0.02, -0.03, 0.04]])
    values = gtsam.Values()
    for node, pose in enumerate(poses):
        values.insert(node, gtsam.Pose2(*pose))
    for off in (0.1, 1.0, 8.0):
        delta = se2.between(poses[0], poses[1]) + off * np.array([1.0, -0.5, 0.2])
        loop = LoopClosure(0, 1, delta, tilted)
        fix = AbsoluteFix(1, poses[1, :2] + off * np.array([0.6, -1.0]), tilted[:2, :2])
        for other, loss in (
            (loop, gtsam.noiseModel.mEstimator.DCS.Create(9.0)),
            (fix, gtsam.noiseModel.mEstimator.Cauchy.Create(2.0)),
        ):
            found, step = other.residual(poses), 1e-5
            assert other.factor(1.0, *other.nodes).error(values) == pytest.approx(loss.loss(found), rel=1e-6)
            slope = (loss.loss(found + step) - loss.loss(found - step)) / (2.0 * step * found)
            assert other.weight(found) == pytest.approx(slope, rel=1e-4)


def test_with_loops_the_answer_is_gtsams_own():
    """Poses and covariances of GTSAM's optimizer and marginals on the same factors."""
    stamps, increments, truth, start, prior = circle(12)
    seen = np.diag([0.4, 0.4, 0.05]) ** 2
    measurements = [GaussianMixture(np.ones(1), pose[None], seen[None]) for pose in truth]
    loop = LoopClosure(0, 11, se2.between(truth[0], truth[11]) + [0.1, 0.0, 0.0], TIGHT, width=1e3)
    settings = SmootherSettings(odometry_kernel="none", outlier_probability=0.0)
    result = smooth(stamps, increments, measurements, prior, start, settings, [loop])

    def noise(covariance, yaw):
        turn = se2.rotation(-yaw)
        return gtsam.noiseModel.Gaussian.Covariance(turn @ covariance @ turn.T, False)

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*prior.mean), noise(prior.covariance, 0.0)))
    for node, increment in enumerate(increments):
        delta = increment.delta
        graph.add(gtsam.BetweenFactorPose2(node, node + 1, gtsam.Pose2(*delta), noise(STEP, delta[2])))
    graph.add(gtsam.BetweenFactorPose2(0, 11, gtsam.Pose2(*loop.delta), noise(TIGHT, loop.delta[2])))
    for node, pose in enumerate(truth):
        graph.add(gtsam.PriorFactorPose2(node, gtsam.Pose2(*pose), noise(seen, pose[2])))
        values.insert(node, gtsam.Pose2(*start.poses[node]))
    values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    marginals = gtsam.Marginals(graph, values)
    for node, pose in enumerate(result.trajectory.poses):
        expected = values.atPose2(node)
        np.testing.assert_allclose(pose[:2], [expected.x(), expected.y()], atol=0.01)
        turn = se2.rotation(pose[2])
        covariance = turn @ marginals.marginalCovariance(node) @ turn.T
        np.testing.assert_allclose(result.trajectory.covariances[node], covariance, atol=1e-3)


@pytest.mark.parametrize(
    ("word", "make"),
    [
        ("different nodes in", lambda: (LoopClosure(3, 3, np.zeros(3), STEP),)),
        ("different nodes in", lambda: (AbsoluteFix(40, np.zeros(2), np.eye(2)),)),
        ("loop closure covariance: expected symmetric", lambda: (LoopClosure(0, 1, np.zeros(3), -STEP),)),
        (r"fix position: expected \(2,\)", lambda: (AbsoluteFix(0, np.zeros(3), np.eye(2)),)),
        ("width: expected > 0", lambda: (AbsoluteFix(0, np.zeros(2), np.eye(2), 0.0),)),
    ],
)
def test_bad_factors_are_refused(word, make):
    stamps, increments, _, start, prior = circle()
    with pytest.raises(SkyfixError, match=word) as caught:
        smooth(stamps, increments, [None] * 40, prior, start, others=make())
    assert "\n" not in str(caught.value)


def test_likelihoods_in_a_graph_of_ones_own_are_the_smoothers():
    """Rounds of GTSAM's own optimizer with native factors end where `smooth` ends."""
    stamps, increments, truth, start, prior = circle(12, seed=3)
    spread, rng = np.diag([0.5, 0.4, 0.05]) ** 2, np.random.default_rng(4)
    measurements = []
    for pose in truth:
        right = pose + rng.multivariate_normal(np.zeros(3), spread)
        both = np.array([right, right + [6.0, 3.0, 0.0]])
        measurements.append(GaussianMixture(np.array([0.5, 0.5]), both, np.array([spread, spread])))
    settings = SmootherSettings(odometry_kernel="none")
    expected = smooth(stamps, increments, measurements, prior, start, settings).trajectory

    def noise(covariance, yaw):
        turn = se2.rotation(-yaw)
        return gtsam.noiseModel.Gaussian.Covariance(turn @ covariance @ turn.T, False)

    mine, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    mine.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*prior.mean), noise(prior.covariance, 0.0)))
    for node, increment in enumerate(increments):
        delta = increment.delta
        mine.add(gtsam.BetweenFactorPose2(node, node + 1, gtsam.Pose2(*delta), noise(STEP, delta[2])))
    for node, pose in enumerate(start.poses):
        values.insert(node, gtsam.Pose2(*pose))
    likelihoods = LikelihoodFactors(range(12), measurements)
    covariances = [np.diag([3.0, 3.0, 0.2]) ** 2] * 12
    for _ in range(8):
        graph = gtsam.NonlinearFactorGraph(mine)
        for factor in likelihoods.at(values, covariances):
            graph.push_back(factor)
        values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        marginals = gtsam.Marginals(graph, values)
        covariances = [marginals.marginalCovariance(node) for node in range(12)]
    found = np.array([[pose.x(), pose.y(), pose.theta()] for pose in (values.atPose2(k) for k in range(12))])
    np.testing.assert_allclose(se2.between(expected.poses, found), 0.0, atol=0.02)
    for node, covariance in enumerate(covariances):
        turn = se2.rotation(found[node, 2])
        np.testing.assert_allclose(turn @ covariance @ turn.T, expected.covariances[node], atol=5e-3)
    with pytest.raises(SkyfixError, match="one measurement a key"):
        LikelihoodFactors([0], measurements)
