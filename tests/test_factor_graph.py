"""The smoother: closed forms where the problem is linear, the right mode elsewhere, the same answer in every frame."""

import time

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from fusion import (
    GaussianMixture,
    OdometryIncrement,
    OdometryNoise,
    SkyfixError,
    SmootherSettings,
    Trajectory,
    UniformPrior,
    se2,
    smooth,
)
from fusion.consistency import coverage, nees
from fusion.graph.measurements import NOT_MEASURED, REJECTED
from fusion.graph.mixture_bank import MixtureBank
from fusion.graph.sites import Sites

STEP_NS = 100_000_000
MEASURED = np.diag([0.5, 0.3, 0.02]) ** 2


def single(mean, covariance=MEASURED):
    return GaussianMixture(np.ones(1), np.asarray(mean)[None], covariance[None])


def drive(count, seed, every=3, outliers=0.0, decoys=0.0, delta=(1.0, 0.0, 0.02), start=(10.0, -5.0, 2.5)):
    """Stamps, increments, measurements, prior and truth of a simulated drive.

    A share of the measurements has all its modes wrong (outliers), another a heavier mode in the wrong place (decoys).
    """
    rng = np.random.default_rng(seed)
    delta, covariance = np.array(delta), OdometryNoise().covariance(delta, 0.1)
    stamps, truth = np.arange(count, dtype=np.int64) * STEP_NS, [np.array(start)]
    for _ in range(count - 1):
        truth.append(se2.compose(truth[-1], delta + rng.multivariate_normal(np.zeros(3), covariance)))
    increments = [OdometryIncrement(int(stamp), delta, covariance) for stamp in stamps[1:]]
    measurements, kinds = [], []
    for node, pose in enumerate(truth):
        if node % every:
            measurements.append(None)
            kinds.append("none")
            continue
        kind = rng.choice(["outlier", "decoy", "single"], p=[outliers, decoys, 1.0 - outliers - decoys])
        right = pose + rng.multivariate_normal(np.zeros(3), MEASURED)
        wrong = pose + rng.choice([-1.0, 1.0], 3) * rng.uniform([6.0, 6.0, 0.0], [15.0, 15.0, 0.1])
        kinds.append(str(kind))
        if kind == "decoy":
            measurements.append(
                GaussianMixture(np.array([0.6, 0.3]), np.array([wrong, right]), np.array([MEASURED] * 2))
            )
        else:
            measurements.append(single(wrong if kind == "outlier" else right))
    prior = UniformPrior(truth[0] + np.array([4.0, -3.0, 0.05]), 20.0, 0.17)
    return stamps, increments, measurements, prior, np.array(truth), kinds


def rough(stamps, truth, seed=0, spread=(1.5, 1.5, 0.05)):
    """Start values as a filter would give them."""
    noise = np.random.default_rng(seed).normal(0.0, spread, truth.shape)
    covariances = np.repeat((np.diag(spread) ** 2)[None], len(truth), axis=0)
    return Trajectory(stamps, truth + noise, covariances)


def errors_of(result, truth):
    errors = result.trajectory.poses - truth
    errors[:, 2] = se2.wrap(errors[:, 2])
    return errors


def test_with_fixed_headings_it_is_the_closed_form_linear_smoother():
    rng, count = np.random.default_rng(0), 40
    yaw = 0.7 + np.cumsum(rng.normal(0.0, 0.3, count))
    stamps, fixed = np.arange(count, dtype=np.int64) * STEP_NS, 1e-6
    deltas = np.column_stack([rng.uniform(0.5, 1.5, (count - 1, 2)), np.diff(yaw)])
    odometry, measured = np.diag([0.3, 0.1, fixed]) ** 2, np.diag([0.8, 0.5, fixed]) ** 2
    measured[0, 1] = measured[1, 0] = 0.2
    steps = se2.transform_points(np.column_stack([np.zeros((count - 1, 2)), yaw[:-1]]), deltas[:, :2])
    positions = np.cumsum(np.vstack([[5.0, 1.0], steps]), axis=0) + rng.normal(0.0, 0.8, (count, 2))
    seen = [node for node in range(count) if node % 4 == 1]
    measurements = [single([*positions[i], yaw[i]], measured) if i in seen else None for i in range(count)]
    increments = [OdometryIncrement(int(stamps[i + 1]), deltas[i], odometry) for i in range(count - 1)]
    prior = UniformPrior(np.array([3.0, 2.0, yaw[0]]), 10.0, fixed)
    initial = Trajectory(stamps, np.column_stack([positions, yaw]))
    settings = SmootherSettings(clutter_log_density=-1e3, odometry_kernel="none")
    result = smooth(stamps, increments, measurements, prior, initial, settings)

    information, vector = np.zeros((2 * count, 2 * count)), np.zeros(2 * count)

    def add(jacobian, value, covariance):
        weight = np.linalg.inv(covariance)
        information[:] += jacobian.T @ weight @ jacobian
        vector[:] += jacobian.T @ weight @ value

    def picks(node):
        matrix = np.zeros((2, 2 * count))
        matrix[:, 2 * node : 2 * node + 2] = np.eye(2)
        return matrix

    add(picks(0), prior.mean[:2], prior.covariance[:2, :2])
    for i in range(count - 1):
        turn = se2.rotation(yaw[i])[:2, :2]
        add(picks(i + 1) - picks(i), turn @ deltas[i, :2], turn @ odometry[:2, :2] @ turn.T)
    for i in seen:
        add(picks(i), positions[i], measured[:2, :2])
    covariance = np.linalg.inv(information)
    mean = (covariance @ vector).reshape(-1, 2)

    np.testing.assert_allclose(result.trajectory.poses[:, :2], mean, atol=1e-6)
    np.testing.assert_allclose(se2.wrap(result.trajectory.poses[:, 2] - yaw), 0.0, atol=1e-5)
    for i in range(count):
        block = covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2]
        np.testing.assert_allclose(result.trajectory.covariances[i, :2, :2], block, atol=1e-6)
    assert result.converged
    np.testing.assert_array_equal(result.chosen, [0 if i in seen else NOT_MEASURED for i in range(count)])


def test_it_is_honest_about_position_and_heading():
    """Mean NEES and coverage over 900 nodes of three drives."""
    values = []
    for seed in range(3):
        stamps, increments, measurements, prior, truth, _ = drive(300, seed)
        result = smooth(stamps, increments, measurements, prior, rough(stamps, truth))
        values.append(nees(errors_of(result, truth), result.trajectory.covariances))
        assert np.linalg.eigvalsh(result.trajectory.covariances).min() > 0.0
    assert 0.75 < np.mean(values) / 3 < 1.25
    assert 0.90 < coverage(np.concatenate(values), 3) < 0.99


def test_it_takes_the_right_mode_and_drops_outliers():
    stamps, increments, measurements, prior, truth, kinds = drive(300, 1, outliers=0.15, decoys=0.35)
    result = smooth(stamps, increments, measurements, prior, rough(stamps, truth))
    wanted = {"none": NOT_MEASURED, "outlier": REJECTED, "decoy": 1, "single": 0}
    right = result.chosen == [wanted[kind] for kind in kinds]
    assert right.mean() > 0.995
    assert result.converged
    errors = errors_of(result, truth)
    assert np.hypot(errors[:, 0], errors[:, 1]).mean() < 0.3


def test_a_start_that_the_modes_do_not_reach_is_no_reason_to_reject_them():
    """The cavity, not the start values, judges: a bias of many mode widths is drawn back."""
    stamps, increments, measurements, prior, truth, _ = drive(120, 2)
    biased = Trajectory(
        stamps, truth + np.array([4.0, -3.0, 0.0]), np.repeat((np.diag([5.0, 5.0, 0.1]) ** 2)[None], 120, axis=0)
    )
    result = smooth(stamps, increments, measurements, prior, biased)
    assert (result.chosen[::3] == 0).all()
    assert np.abs(errors_of(result, truth)[:, :2]).mean() < 0.3


def test_one_outlier_does_not_move_its_neighbours():
    stamps, increments, measurements, prior, truth, _ = drive(60, 3)
    initial = rough(stamps, truth, spread=(0.3, 0.3, 0.02))
    without = list(measurements)
    without[30] = None
    with_outlier = list(measurements)
    with_outlier[30] = single(truth[30] + [8.0, 5.0, 0.0])
    a = smooth(stamps, increments, without, prior, initial)
    b = smooth(stamps, increments, with_outlier, prior, initial)
    assert b.chosen[30] == REJECTED
    np.testing.assert_allclose(a.trajectory.poses, b.trajectory.poses, atol=1e-6)


@pytest.mark.parametrize("kernel", ["huber", "dcs"])
def test_a_failed_registration_is_bridged_by_a_robust_kernel(kernel):
    stamps, increments, measurements, prior, truth, _ = drive(90, 4, every=1)
    slipped = list(increments)
    wrong = increments[44]
    slipped[44] = OdometryIncrement(wrong.stamp_ns, wrong.delta + np.array([6.0, 1.0, 0.0]), wrong.covariance)

    def worst(name):
        settings = SmootherSettings(odometry_kernel=name)
        result = smooth(stamps, slipped, measurements, prior, rough(stamps, truth, spread=(0.3, 0.3, 0.02)), settings)
        return np.abs(errors_of(result, truth)[35:55, :2]).max()

    assert worst(kernel) < 0.75 * worst("none")


def test_without_measurements_it_is_the_odometry_from_the_prior():
    stamps, increments, _, prior, _, _ = drive(30, 5)
    poses = [prior.mean]
    for increment in increments:
        poses.append(se2.compose(poses[-1], increment.delta))
    result = smooth(stamps, increments, [None] * 30, prior, Trajectory(stamps, np.array(poses)))
    np.testing.assert_allclose(result.trajectory.poses, poses, atol=1e-6)
    np.testing.assert_allclose(result.trajectory.covariances[0], prior.covariance, rtol=1e-6, atol=1e-6)  # of 133 m²
    areas = np.linalg.det(result.trajectory.covariances[:, :2, :2])
    assert (np.diff(areas) > 0).all()  # nothing but drift
    assert (result.chosen == NOT_MEASURED).all()


@pytest.mark.parametrize("frame", [(5e5, 4e6, 0.0), (0.0, 0.0, 2.0), (-300.0, 20.0, -2.9)])
def test_moving_and_turning_the_map_moves_and_turns_the_answer(frame):
    frame = np.array(frame)
    turn = se2.rotation(frame[2])
    stamps, increments, measurements, prior, truth, _ = drive(100, 6, outliers=0.1, decoys=0.2)
    initial = rough(stamps, truth)

    def moved(mixture):
        covariances = turn @ mixture.covariances @ turn.T
        return GaussianMixture(mixture.weights, se2.compose(frame, mixture.means), covariances)

    a = smooth(stamps, increments, measurements, prior, initial)
    b = smooth(
        stamps,
        increments,
        [None if mixture is None else moved(mixture) for mixture in measurements],
        UniformPrior(se2.compose(frame, prior.centre), prior.half_extent_m, prior.half_heading_rad),
        Trajectory(stamps, se2.compose(frame, initial.poses), turn @ initial.covariances @ turn.T),
    )
    np.testing.assert_array_equal(a.chosen, b.chosen)
    difference = se2.between(se2.compose(frame, a.trajectory.poses), b.trajectory.poses)
    np.testing.assert_allclose(difference, 0.0, atol=1e-4)
    np.testing.assert_allclose(turn @ a.trajectory.covariances @ turn.T, b.trajectory.covariances, atol=1e-5)


def test_unknown_heading_at_the_start_is_found():
    stamps, increments, measurements, _, truth, _ = drive(60, 7)
    prior = UniformPrior(truth[0] + np.array([3.0, 3.0, 2.0]), 10.0, np.pi)
    result = smooth(stamps, increments, measurements, prior, rough(stamps, truth))
    assert np.abs(errors_of(result, truth)[:, 2]).max() < 0.1


def test_fifteen_hundred_nodes_take_seconds():
    stamps, increments, measurements, prior, truth, _ = drive(1500, 8, outliers=0.1, decoys=0.3)
    start = time.perf_counter()
    result = smooth(stamps, increments, measurements, prior, rough(stamps, truth))
    assert time.perf_counter() - start < 10.0
    assert result.iterations <= 20


def test_cavities_take_out_exactly_one_measurement():
    """Marginal = cavity x measurement: for Gaussians the product is undone to rounding."""
    cavity_mean, cavity = np.array([1.0, 2.0, 3.0]), np.diag([4.0, 1.0, 0.01])
    measured_mean, measured = cavity_mean + np.array([0.5, -0.3, 0.4]), MEASURED
    information = np.linalg.inv(cavity) + np.linalg.inv(measured)
    marginal = np.linalg.inv(information)
    step = marginal @ np.linalg.solve(measured, measured_mean - cavity_mean)
    sites = Sites(se2.wrap(measured_mean)[None], np.linalg.inv(measured)[None], np.zeros((1, 3)))
    means, spreads = sites.cavities((cavity_mean + step)[None], marginal[None])
    np.testing.assert_allclose(means[0], cavity_mean, atol=1e-9)
    np.testing.assert_allclose(spreads[0], cavity, atol=1e-9)


def test_choice_weighs_evidence_against_the_null_hypothesis():
    modes = GaussianMixture(np.array([0.7, 0.3]), np.array([[5.0, 0, 0], [0.2, 0, 0]]), np.array([MEASURED] * 2))
    pose, tight, wide = np.zeros((1, 3)), MEASURED[None], np.diag([25.0, 25.0, 0.01])[None]

    def best(centre, spread, outlier_probability=0.05, clutter=-9.2):
        return MixtureBank([modes], outlier_probability, clutter).windowed(centre, spread)[1][0]

    assert best(pose, tight) == 1
    assert best(pose, wide) == 0  # undecided by place: the heavier
    assert best(pose + np.array([0, 9.0, 0]), tight) == REJECTED
    assert best(pose, tight, 0.999999, 5.0) == REJECTED


def test_bad_input_is_refused():
    stamps, increments, measurements, prior, truth, _ = drive(5, 10)
    initial = rough(stamps, truth)
    short = Trajectory(initial.stamp_ns[:2], initial.poses[:2])
    shifted = [OdometryIncrement(one.stamp_ns + 1, one.delta, one.covariance) for one in increments]
    for word, call in {
        "4 increments": lambda: smooth(stamps, increments[:-1], measurements, prior, initial),
        "5 measurements": lambda: smooth(stamps, increments, measurements[:-1], prior, initial),
        "other stamps": lambda: smooth(stamps, shifted, measurements, prior, initial),
        "expected stamps in": lambda: smooth(stamps, increments, measurements, prior, short),
        "int64": lambda: smooth(stamps * 1e-9, increments, measurements, prior, initial),
        "outlier_probability": lambda: SmootherSettings(outlier_probability=1.0),
        "clutter": lambda: SmootherSettings(clutter_log_density=-np.inf),
        "kernel:": lambda: SmootherSettings(odometry_kernel="cauchy"),
        "kernel_width": lambda: SmootherSettings(odometry_kernel_width=0.0),
        "max_iterations": lambda: SmootherSettings(max_iterations=0),
    }.items():
        with pytest.raises(SkyfixError, match=word) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_evidence_of_one_pose_is_that_of_the_prior_and_the_measurement() -> None:
    """ln N(mean; prior mean, P + S), up to a constant of the graph: its differences between measurements."""
    prior = UniformPrior(np.array([3.0, -2.0, 0.3]), 2.0, 0.05)
    initial = Trajectory(np.array([0]), prior.mean[None], prior.covariance[None])
    found, exact = [], []
    for sigma, off in ((0.3, 0.0), (1.0, 0.5), (3.0, -1.0)):
        mean = prior.mean + [off, 0.5 * off, 0.01 * off]
        covariance = np.diag([sigma, 0.5 * sigma, 0.02 * sigma]) ** 2
        seen = GaussianMixture(np.ones(1), mean[None], covariance[None])
        settings = SmootherSettings(outlier_probability=1e-9)
        found.append(smooth(np.array([0]), [], [seen], prior, initial, settings).log_evidence)
        exact.append(float(multivariate_normal(prior.mean, prior.covariance + covariance).logpdf(mean)))
    np.testing.assert_allclose(np.diff(found), np.diff(exact), atol=1e-3)
