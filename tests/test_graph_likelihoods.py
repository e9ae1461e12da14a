"""Whole likelihoods in the graph: closed forms, the exact grid, frames, derivatives, drift, far starts."""

import gtsam
import numpy as np
import pytest

from fusion import (
    GaussianLikelihood,
    GaussianMixture,
    GridFilter,
    LikelihoodVolume,
    MapGrid,
    OdometryDrift,
    OdometryIncrement,
    OdometryNoise,
    SkyfixError,
    SmootherSettings,
    Trajectory,
    UniformPrior,
    se2,
    smooth,
    smooth_on_grid,
)
from fusion.factor_graph import REJECTED
from fusion.graph.chain import Chain
from fusion.graph.chain_marginals import chain_covariances
from fusion.graph.likelihood_bank import LikelihoodBank
from fusion.graph.odometry_factors import calibrated, calibration_derivative
from fusion.graph.patch import Neighbourhood, patch_of
from fusion.odometry import accumulate

SECOND = 1_000_000_000
CERTAIN = SmootherSettings(outlier_probability=0.0, odometry_kernel="none")
SEEN = np.diag([0.9, 0.6, 0.06]) ** 2


def volume(mixture, grid, bins=90):
    """A likelihood on a grid."""
    x, y = grid.centres()
    yaw = np.arange(bins) * 2.0 * np.pi / bins
    poses = np.stack(np.meshgrid(y, x, yaw, indexing="ij"), axis=-1)[..., [1, 0, 2]]
    scores = mixture.log_density(poses.reshape(-1, 3)).reshape(poses.shape[:3])
    return LikelihoodVolume.from_scores(np.maximum(scores, -60.0), grid)


def one(mean, covariance=SEEN):
    return GaussianMixture(np.ones(1), np.asarray(mean)[None], covariance[None])


def drive(count, seed, start=(0.0, 0.0, 0.4), step=(2.0, 0.0, 0.05)):
    """Stamps, increments and truth."""
    rng = np.random.default_rng(seed)
    stamps, truth, increments = np.arange(count) * SECOND, [np.array(start)], []
    for stamp in stamps[1:]:
        covariance = np.diag([0.2, 0.15, 0.02]) ** 2
        truth.append(se2.compose(truth[-1], np.array(step)))
        delta = np.array(step) + rng.multivariate_normal(np.zeros(3), covariance)
        increments.append(OdometryIncrement(int(stamp), delta, covariance))
    return stamps, increments, np.array(truth), rng


def rough(stamps, truth, off=(0.5, -0.5, 0.03)):
    return Trajectory(stamps, truth + np.array(off), np.repeat((np.diag([1.0, 1.0, 0.1]) ** 2)[None], len(truth), 0))


def straight_gauss_markov(count, seed):
    """A drive whose headings are known: increments, likelihoods' means, and the closed-form smoother of positions."""
    rng, turn = np.random.default_rng(seed), se2.rotation(0.3)[:2, :2]
    odometry, seen = np.diag([0.3, 0.2]) ** 2, np.array([[0.5, 0.1], [0.1, 0.3]])
    truth = np.arange(count)[:, None] * (turn @ [1.0, 0.0])
    deltas = np.array([[1.0, 0.0]] * (count - 1)) + rng.normal(0.0, [0.3, 0.2], (count - 1, 2))
    means = truth + rng.multivariate_normal(np.zeros(2), seen, count)
    information, vector = np.zeros((2 * count, 2 * count)), np.zeros(2 * count)
    turned = np.linalg.inv(turn @ odometry @ turn.T)
    pick = np.eye(2 * count).reshape(count, 2, 2 * count)
    terms = [(pick[0], np.zeros(2), np.eye(2) * 3.0 / 20.0**2)]
    terms += [(pick[k + 1] - pick[k], turn @ deltas[k], turned) for k in range(count - 1)]
    terms += [(pick[k], means[k], np.linalg.inv(seen)) for k in range(count)]
    for jacobian, value, weight in terms:
        information += jacobian.T @ weight @ jacobian
        vector += jacobian.T @ weight @ value
    return odometry, seen, deltas, means, np.linalg.solve(information, vector), np.linalg.inv(information)


def test_gaussian_likelihoods_give_the_closed_form_smoother():
    """Mean and covariance to 1e-6, whole likelihoods; a bad start and headings that are known."""
    count, fixed = 30, 1e-5
    odometry, seen, deltas, means, mean, covariance = straight_gauss_markov(count, 0)
    wide, tight = np.zeros((3, 3)), np.diag([0.0, 0.0, fixed**2])
    stamps, grid = np.arange(count) * SECOND, MapGrid(200, 200, 1.0, -100.0, -100.0)
    spread = wide.copy()
    spread[:2, :2] = odometry
    increments = [
        OdometryIncrement(int(stamp), np.append(delta, 0.0), spread + tight)
        for stamp, delta in zip(stamps[1:], deltas, strict=True)
    ]
    spread = wide.copy()
    spread[:2, :2] = seen
    likelihoods = [GaussianLikelihood(np.append(at, 0.3), spread + tight, grid) for at in means]
    start = Trajectory(stamps, np.column_stack([means + 3.0, np.full(count, 0.3)]))
    prior = UniformPrior(np.array([0.0, 0.0, 0.3]), 20.0, np.sqrt(3.0) * fixed)
    result = smooth(stamps, increments, likelihoods, prior, start, CERTAIN)
    assert result.converged
    np.testing.assert_allclose(result.trajectory.poses[:, :2].ravel(), mean, atol=1e-6)
    for k in range(count):
        block = covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        np.testing.assert_allclose(result.trajectory.covariances[k, :2, :2], block, atol=1e-6)


@pytest.mark.parametrize("sigma", [0.2, 0.6, 3.0, 8.0])
def test_moments_under_a_window_are_those_of_the_product(sigma):
    """A Gaussian on a grid under narrow and wide windows: evidence, mean and covariance of the product."""
    grid, rng = MapGrid(60, 60, 0.5, -15.0, -15.0), np.random.default_rng(3)
    spread = np.array([[1.2, 0.3, 0.02], [0.3, 0.8, -0.01], [0.02, -0.01, 0.02]])
    centre, at = np.array([0.7, -0.4, 3.1]), np.array([0.2, 0.3, -3.1])
    bank = LikelihoodBank([patch_of(volume(one(at, spread), grid, 180))], 0.0)
    root = rng.normal(0.0, 0.2, (3, 3)) + np.eye(3)
    axes = np.diag([sigma, sigma, 0.1 * min(sigma, 2.0)])
    window = axes @ root @ root.T @ axes
    found = bank.windowed(centre[None], window[None])
    off = at - centre
    off[2] = se2.wrap(off[2])
    total = np.linalg.inv(np.linalg.inv(spread) + np.linalg.inv(window))
    mean = total @ np.linalg.solve(spread, off)
    scale = np.sqrt(np.diag(total))
    np.testing.assert_allclose((found.roots[0] @ found.means[0] - mean) / scale, 0.0, atol=0.02)
    product = found.roots[0] @ found.spreads[0] @ found.roots[0].T
    np.testing.assert_allclose(product / np.outer(scale, scale), total / np.outer(scale, scale), atol=0.05)
    evidence = one(at, spread + window).log_density(centre[None])[0]
    np.testing.assert_allclose(found.log_mass[0], evidence, atol=0.15)
    precision, information = found.factors()
    units = np.sqrt(np.diag(spread))
    np.testing.assert_allclose(precision[0] @ spread * units[:, None] / units, np.eye(3), atol=0.05)
    np.testing.assert_allclose(np.linalg.solve(precision[0], information[0]), off, atol=0.05)


def test_volumes_of_gaussians_give_what_the_gaussians_give():
    stamps, increments, truth, rng = drive(12, 1)
    grid = MapGrid(44, 44, 1.0, -10.0, -14.0)
    means = [pose + rng.multivariate_normal(np.zeros(3), SEEN) for pose in truth]
    prior = UniformPrior(truth[0], 5.0, 0.3)
    exact = smooth(stamps, increments, [one(m) for m in means], prior, rough(stamps, truth), CERTAIN)
    whole = smooth(stamps, increments, [volume(one(m), grid) for m in means], prior, rough(stamps, truth), CERTAIN)
    sigma = np.sqrt(np.diagonal(exact.trajectory.covariances, axis1=1, axis2=2))
    np.testing.assert_allclose((whole.trajectory.poses - exact.trajectory.poses) / sigma, 0.0, atol=0.03)
    ratio = np.diagonal(whole.trajectory.covariances, axis1=1, axis2=2) / sigma**2
    np.testing.assert_allclose(ratio, 1.0, atol=0.05)


def test_skewed_and_two_peaked_likelihoods_agree_with_the_exact_grid():
    """Means and covariances of forward-backward on a grid, where one Gaussian a mode is off."""
    stamps, increments, truth, rng = drive(5, 2, start=(-4.0, 0.0, 0.0), step=(1.5, 0.0, 0.0))
    grid = MapGrid(40, 40, 0.5, -10.0, -10.0)
    likelihoods = []
    for pose in truth:
        at = pose + rng.normal(0.0, [0.4, 0.4, 0.03])
        tail = GaussianMixture(  # a peak with a long tail to the east, and a second street
            np.array([0.4, 0.35, 0.25]),
            np.array([at, at + [2.5, 0.0, 0.0], at + [0.0, 6.0, 0.0]]),
            np.array([np.diag([0.9, 0.9, 0.15]), np.diag([1.8, 0.9, 0.15]), np.diag([0.9, 0.9, 0.15])]) ** 2,
        )
        likelihoods.append(volume(tail, grid, 90))
    prior = UniformPrior(truth[0], 3.0, 0.3)
    exact = smooth_on_grid(GridFilter.from_prior(prior, grid, 90), 0, increments, likelihoods)
    settings = SmootherSettings(odometry_kernel="none", outlier_probability=0.05)
    found = smooth(stamps, increments, likelihoods, prior, rough(stamps, truth), settings)
    sigma = np.sqrt(np.diagonal(exact.trajectory.covariances, axis1=1, axis2=2))
    off = (found.trajectory.poses - exact.trajectory.poses) / sigma
    assert np.abs(off).max() < 0.35
    ratio = np.diagonal(found.trajectory.covariances, axis1=1, axis2=2) / sigma**2
    assert ratio.min() > 0.6
    assert ratio.max() < 1.6


@pytest.mark.parametrize("frame", [(5e5, 4e6, 0.0), (0.0, 0.0, np.pi / 2), (-300.0, 20.0, np.pi)])
def test_moving_and_turning_the_map_moves_and_turns_the_answer(frame):
    """Quarter turns, which a grid can follow: to numerical precision of its float32."""
    frame = np.array(frame)
    stamps, increments, truth, rng = drive(8, 4)
    means = [pose + rng.multivariate_normal(np.zeros(3), SEEN) for pose in truth]
    middle = truth[:, :2].mean(axis=0)

    def result(moved):
        placed = se2.compose(moved, np.array(means))
        corner = se2.transform_points(moved, middle) - 15.0
        grid = MapGrid(30, 30, 1.0, *corner)
        turn = se2.rotation(moved[2])
        seen = [volume(one(m, turn @ SEEN @ turn.T), grid, 120) for m in placed]
        start = rough(stamps, truth)
        initial = Trajectory(stamps, se2.compose(moved, start.poses), turn @ start.covariances @ turn.T)
        return smooth(stamps, increments, seen, UniformPrior(se2.compose(moved, truth[0]), 5.0, 0.3), initial)

    a, b, turn = result(np.zeros(3)), result(frame), se2.rotation(frame[2])
    difference = se2.between(se2.compose(frame, a.trajectory.poses), b.trajectory.poses)
    np.testing.assert_allclose(difference, 0.0, atol=2e-3)
    np.testing.assert_allclose(turn @ a.trajectory.covariances @ turn.T, b.trajectory.covariances, atol=2e-3)


def test_a_likelihood_about_another_place_counts_for_nothing():
    stamps, increments, truth, rng = drive(15, 5)
    grid = MapGrid(44, 44, 1.0, -10.0, -10.0)
    seen = [volume(one(pose + rng.multivariate_normal(np.zeros(3), SEEN)), grid) for pose in truth]
    wrong = list(seen)
    wrong[7] = volume(one(truth[7] + [9.0, 6.0, 0.3]), grid)
    without = [None if k == 7 else likelihood for k, likelihood in enumerate(seen)]
    prior = UniformPrior(truth[0], 5.0, 0.3)
    a, b = (smooth(stamps, increments, which, prior, rough(stamps, truth)) for which in (wrong, without))
    assert a.chosen[7] == REJECTED
    np.testing.assert_allclose(a.trajectory.poses, b.trajectory.poses, atol=5e-3)


def test_derivatives_by_the_calibration_are_finite_differences():
    rng = np.random.default_rng(6)
    deltas, calibration = rng.normal(0.0, [2.0, 0.3, 0.2], (20, 3)), rng.normal(0.0, [0.02, 0.02, 0.01], (20, 3))
    analytic = calibration_derivative(deltas, calibrated(deltas, calibration))
    for axis in range(3):
        step = np.eye(3)[axis] * 1e-6
        numeric = (calibrated(deltas, calibration + step) - calibrated(deltas, calibration - step)) / 2e-6
        np.testing.assert_allclose(analytic[:, :, axis], numeric, atol=1e-7)


def test_composed_motions_are_those_of_accumulate():
    _, increments, _, _ = drive(30, 7)
    nodes = np.array([0, 4, 5, 17, 29])
    chain = Chain.of(increments).between(nodes)
    for delta, covariance, first, last in zip(chain.deltas, chain.covariances, nodes, nodes[1:], strict=False):
        expected = accumulate(increments[first:last])
        np.testing.assert_allclose(delta, expected.delta, atol=1e-12)
        np.testing.assert_allclose(covariance, expected.covariance, atol=1e-12)


def test_covariances_of_a_chain_with_calibrations_are_gtsams():
    rng, unit = np.random.default_rng(8), gtsam.noiseModel.Unit.Create(3)
    order = [0, 1, 2, 10, 3, 4, 11, 5]  # poses 0 to 5, calibrations 10 and 11
    graph, used = gtsam.GaussianFactorGraph(), {0: 10, 1: 10, 2: 10, 3: 11, 4: 11}

    def block():
        return rng.normal(size=(3, 3)) + 2.0 * np.eye(3)

    graph.add(0, block(), rng.normal(size=3), unit)
    graph.add(10, block(), rng.normal(size=3), unit)
    graph.push_back(gtsam.JacobianFactor(10, block(), 11, block(), rng.normal(size=3), unit))
    for node, calibration in used.items():
        graph.push_back(
            gtsam.JacobianFactor(node, block(), node + 1, block(), calibration, block(), rng.normal(size=3), unit)
        )
    ordering = gtsam.Ordering()
    for key in order:
        ordering.push_back(key)
    found = chain_covariances(graph.eliminateSequential(ordering), np.array([key >= 10 for key in order]).astype(int))
    marginals = gtsam.Marginals(graph, graph.optimize())
    for key, covariance in zip(order, found, strict=True):
        np.testing.assert_allclose(covariance, marginals.marginalCovariance(key), rtol=1e-8, atol=1e-10)


def test_scale_and_heading_bias_are_found_over_a_kilometre():
    """3 % and 0.2 degrees per 100 m to 0.3 % and 0.03 degrees per 100 m, where the map speaks every 4 m."""
    rng, count = np.random.default_rng(9), 251
    noise, scale, bias = OdometryNoise(0.03, 0.02, 5e-5, 5e-4, 0.005, 1e-5), np.log(1.03), np.deg2rad(0.2) / 100.0
    stamps, truth, increments = np.arange(count) * SECOND, [np.zeros(3)], []
    for node in range(1, count):
        delta = np.array([4.0, 0.0, 0.08 * np.sin(0.05 * node)])
        truth.append(se2.compose(truth[-1], delta))
        told = np.array([*(delta[:2] / np.exp(scale)), delta[2] - bias * 4.0 / 1.03])
        covariance = noise.covariance(delta, 1.0)
        told += rng.multivariate_normal(np.zeros(3), covariance)
        increments.append(OdometryIncrement(node * SECOND, told, covariance))
    truth = np.array(truth)
    seen = [one(pose + rng.multivariate_normal(np.zeros(3), SEEN)) for pose in truth]
    drift = OdometryDrift(
        log_scale=0.05, log_scale_walk=1e-5, mount_yaw_walk_rad=1e-5, heading_bias_walk_rad_per_m=1e-8
    )
    settings = SmootherSettings(drift=drift)
    result = smooth(stamps, increments, seen, UniformPrior(truth[0], 5.0, 0.2), rough(stamps, truth), settings)
    found, spread = result.calibrations.mean(axis=0), np.sqrt(np.diagonal(result.calibration_covariances[0]))
    assert abs(np.exp(found[0]) / np.exp(scale) - 1.0) < 0.003
    assert abs(np.rad2deg(found[2] - bias) * 100.0) < 0.03
    assert (np.abs(found - [scale, 0.0, bias]) < 4.0 * spread).all()


def test_only_the_neighbourhood_of_a_likelihood_is_kept():
    grid = MapGrid(60, 60, 0.5, -15.0, -15.0)
    likelihood = volume(one([0.0, 0.0, -3.1]), grid, 120)
    patch = patch_of(likelihood, Neighbourhood(np.array([1.0, 0.0, 3.1]), 4.0, 0.3))
    assert patch.log_prob.shape[0] < 20
    assert 8 < patch.log_prob.shape[2] < 14
    assert patch_of(likelihood.with_outliers(0.1)).log_prob.shape == (60, 60, 120)
    sampled = patch_of(GaussianLikelihood(np.zeros(3), SEEN, grid), Neighbourhood(np.zeros(3), 4.0, 0.3))
    assert sampled.log_prob.shape[:2] == (17, 17)
    with pytest.raises(SkyfixError, match="neighbourhood: expected extents > 0"):
        Neighbourhood(np.zeros(3), 0.0)
    with pytest.raises(SkyfixError, match="drift log_scale: expected > 0"):
        OdometryDrift(log_scale=0.0)
    with pytest.raises(SkyfixError, match="expected huber or none"):
        SmootherSettings(drift=OdometryDrift(), odometry_kernel="dcs")


def far_start(seed, count=20):
    """A drive started 8 m and 8 degrees off; three in ten likelihoods have their higher mode in a wrong place."""
    stamps, increments, truth, rng = drive(count, seed, step=(4.0, 0.0, 0.03))
    grids = [MapGrid(40, 40, 1.0, *(pose[:2] - 20.0 + rng.uniform(-3.0, 3.0, 2))) for pose in truth]
    seen = []
    for pose, grid in zip(truth, grids, strict=True):
        right = pose + rng.multivariate_normal(np.zeros(3), SEEN)
        wrong = pose + se2.compose(
            np.array([0.0, 0.0, rng.uniform(-3.0, 3.0)]), np.array([rng.uniform(5.0, 12.0), 0.0, 0.0])
        ) * [1, 1, 0]
        weights = np.array([0.25, 0.75] if rng.random() < 0.3 else [0.8, 0.2])
        seen.append(volume(GaussianMixture(weights, np.array([right, wrong]), np.array([SEEN, SEEN])), grid, 60))
    angle = rng.uniform(-np.pi, np.pi)
    poses = [truth[0] + [8.0 * np.cos(angle), 8.0 * np.sin(angle), np.deg2rad(8.0) * rng.choice([-1.0, 1.0])]]
    for increment in increments:
        poses.append(se2.compose(poses[-1], increment.delta))
    spread = np.repeat((np.diag([8.0, 8.0, np.deg2rad(8.0)]) ** 2)[None], count, axis=0)
    prior = UniformPrior(truth[0], 20.0, 0.3)
    return stamps, increments, seen, prior, Trajectory(stamps, np.array(poses), spread), truth


@pytest.mark.parametrize("seed", range(6))
def test_a_start_far_off_among_false_modes_ends_at_the_truth(seed):
    stamps, increments, seen, prior, start, truth = far_start(seed)
    found = smooth(stamps, increments, seen, prior, start)
    off = found.trajectory.poses - truth
    assert np.hypot(off[:, 0], off[:, 1]).mean() < 1.0
    assert np.rad2deg(np.abs(se2.wrap(off[:, 2])).mean()) < 2.0


def test_of_several_starts_the_most_probable_wins():
    stamps, increments, seen, prior, _, truth = far_start(0)
    near, lost = rough(stamps, truth), rough(stamps, truth, off=(15.0, 15.0, 0.0))
    assert smooth(stamps, increments, seen, prior, [lost, near]).log_evidence == pytest.approx(
        smooth(stamps, increments, seen, prior, near).log_evidence, abs=1e-3
    )
    with pytest.raises(SkyfixError, match="initial: expected at least one trajectory"):
        smooth(stamps, increments, seen, prior, [])
