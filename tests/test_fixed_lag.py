"""The fixed-lag smoother against the offline one, GTSAM and the Kalman filter; lateness, bounds, bad input."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_streams import KalmanFilter
from test_graph_likelihoods import CERTAIN, SECOND, SEEN, drive, rough, volume

from fusion import (
    FixedLagSettings,
    FixedLagSmoother,
    GaussianLikelihood,
    GaussianMixture,
    MapGrid,
    OdometryIncrement,
    Outcome,
    SkyfixError,
    SmootherSettings,
    UniformPrior,
    accumulate,
    se2,
    smooth,
)
from fusion.graph.assembly import gtsam_graph
from fusion.graph.chain import Chain
from fusion.graph.chain_solver import solve_chain
from fusion.graph.lag_window import LagWindow
from fusion.graph.sites import Sites

GRID = MapGrid(400, 400, 1.0, -200.0, -200.0)
EXACT = {"outlier_probability": 0.0, "huber_width": np.inf}


def gaussians(truth, rng):
    """Likelihoods around the truth."""
    return [GaussianLikelihood(at + rng.multivariate_normal(np.zeros(3), SEEN), SEEN, GRID) for at in truth]


def fed(smoother, increments, likelihoods):
    """In order of time; the evidence of each likelihood."""
    evidence = [smoother.add_likelihood(0, likelihoods[0]).log_evidence]
    for increment, likelihood in zip(increments, likelihoods[1:], strict=True):
        smoother.add_odometry(increment)
        evidence.append(smoother.add_likelihood(increment.stamp_ns, likelihood).log_evidence)
    return evidence


def arrays(window: LagWindow):
    """All numbers of a window."""
    return {name: getattr(window, name) for name in LagWindow.__slots__ if name != "measurements"}


def test_the_chain_is_solved_as_gtsam_solves_it():
    """Poses and covariances, with a registration that failed under Huber's loss, pulls on every third pose."""
    count = 60
    stamps, increments, truth, rng = drive(count, 1)
    bad = increments[30]
    increments[30] = OdometryIncrement(bad.stamp_ns, bad.delta + [3.0, 1.0, 0.1], bad.covariance)
    chain, prior = Chain.of(increments), UniformPrior(truth[0] + [1.0, 1.0, 0.1], 5.0, 0.3)
    nodes = np.arange(0, count, 3)
    reference = truth[nodes] + rng.multivariate_normal(np.zeros(3), SEEN, len(nodes))
    sites = Sites(reference, np.repeat(np.linalg.inv(SEEN)[None], len(nodes), 0), rng.normal(size=(len(nodes), 3)))
    graph = gtsam_graph(chain, prior, SmootherSettings())
    solution = graph.at(rough(stamps, truth).poses.copy(), nodes, sites)
    for _ in range(15):
        solution = graph.step(solution, nodes, sites)
    references, precisions, informations = np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros((count, 3))
    references[nodes], precisions[nodes], informations[nodes] = reference, sites.precision, sites.information
    poses, covariances = rough(stamps, truth).poses.copy(), np.empty((count, 3, 3))
    steps = solve_chain(
        poses,
        prior.mean,
        prior.covariance,
        chain.deltas,
        chain.covariances,
        4.0,
        references,
        precisions,
        informations,
        30,
        1e-9,
        covariances,
    )
    assert steps < 30
    np.testing.assert_allclose(poses, solution.poses, atol=1e-6)
    np.testing.assert_allclose(covariances, solution.covariances, atol=1e-6)


def test_with_a_lag_longer_than_the_drive_it_is_the_offline_smoother():
    stamps, increments, truth, rng = drive(40, 1)
    likelihoods, prior = gaussians(truth, rng), UniformPrior(truth[0], 5.0, 0.3)
    smoother = FixedLagSmoother.from_prior(0, prior, FixedLagSettings(lag=50, **EXACT))
    fed(smoother, increments, likelihoods)
    offline = smooth(stamps, increments, likelihoods, prior, rough(stamps, truth), CERTAIN)
    found = smoother.trajectory()
    np.testing.assert_array_equal(found.stamp_ns, stamps)
    np.testing.assert_allclose(found.poses, offline.trajectory.poses, atol=1e-6)
    np.testing.assert_allclose(found.covariances, offline.trajectory.covariances, atol=1e-6)


def test_with_whole_likelihoods_too_it_is_the_offline_smoother():
    """Two peaks each, and outliers: to a twentieth of a standard deviation, the staleness that sites may have."""
    stamps, increments, truth, rng = drive(14, 2, step=(1.5, 0.0, 0.05))
    grid, likelihoods = MapGrid(40, 40, 1.0, -8.0, -10.0), []
    for pose in truth:
        at = pose + rng.multivariate_normal(np.zeros(3), SEEN)
        both = GaussianMixture(np.array([0.6, 0.4]), np.array([at, at + [0.0, 9.0, 0.0]]), np.array([SEEN, SEEN]))
        likelihoods.append(volume(both, grid, 60))
    prior = UniformPrior(truth[0], 2.0, 0.3)
    smoother = FixedLagSmoother.from_prior(0, prior, FixedLagSettings(huber_width=np.inf))
    fed(smoother, increments, likelihoods)
    offline = smooth(
        stamps, increments, likelihoods, prior, rough(stamps, truth), SmootherSettings(odometry_kernel="none")
    )
    sigma = np.sqrt(np.diagonal(offline.trajectory.covariances, axis1=1, axis2=2))
    found = smoother.trajectory()
    np.testing.assert_allclose((found.poses - offline.trajectory.poses) / sigma, 0.0, atol=0.05)
    np.testing.assert_allclose(np.diagonal(found.covariances, axis1=1, axis2=2) / sigma**2, 1.0, atol=0.1)


@pytest.mark.parametrize("lag", [2, 5, 30])
def test_the_newest_pose_is_the_kalman_filters(lag):
    """Headings that are known make the problem linear: mean, covariance, and the evidence of every measurement."""
    count, rng, fixed = 60, np.random.default_rng(3), 1e-6
    odometry, seen = np.diag([0.3, 0.2, fixed]) ** 2, np.diag([0.7, 0.5, 0.02]) ** 2
    start = np.array([2.0, -1.0, 0.3])
    truth, smoother = (
        start.copy(),
        FixedLagSmoother(0, start, np.diag([3.0, 2.0, fixed]) ** 2, FixedLagSettings(lag=lag, **EXACT)),
    )
    reference = KalmanFilter(start, np.diag([3.0, 2.0, fixed]) ** 2)
    for k in range(1, count):
        truth = se2.compose(truth, np.array([1.0, 0.0, 0.0]))
        delta = np.array([1.0, 0.0, 0.0]) + rng.normal(0.0, [0.3, 0.2, 0.0])
        increment = OdometryIncrement(k * SECOND, delta, odometry)
        likelihood = GaussianLikelihood(truth + rng.multivariate_normal(np.zeros(3), seen), seen, GRID)
        smoother.add_odometry(increment)
        reference.predict(increment)
        report, expected = smoother.add_likelihood(k * SECOND, likelihood), reference.update(likelihood)
        np.testing.assert_allclose(report.log_evidence, expected.log_evidence, atol=1e-5)
        estimate = smoother.estimate()
        np.testing.assert_allclose(estimate.pose, reference.current.mean, atol=1e-6)
        np.testing.assert_allclose(estimate.covariance, reference.current.covariance, atol=1e-6)
    assert len(smoother) == lag


def test_what_comes_late_counts_as_in_time():
    """Up to 8 poses late with a lag of 20, to 0.02 standard deviations: poses left while it was missing, and were
    linearised elsewhere, which is second order in how far it moves them. Evidence adds up to the same, likewise."""
    _, increments, truth, rng = drive(60, 4)
    likelihoods, prior = gaussians(truth, rng), UniformPrior(truth[0], 5.0, 0.3)
    limits = FixedLagSettings(lag=20, **EXACT)
    in_time, late = (FixedLagSmoother.from_prior(0, prior, limits) for _ in range(2))
    fed(in_time, increments, likelihoods)
    arrival = np.arange(60) + np.where(np.arange(60) < 50, rng.integers(0, 9, 60), 0)
    for now in range(60):
        if now:
            late.add_odometry(increments[now - 1])
        for k in np.flatnonzero(arrival == now):
            assert late.add_likelihood(int(k) * SECOND, likelihoods[k]).outcome is Outcome.USED
    assert late.counts.likelihoods == in_time.counts.likelihoods == 60
    assert late.counts.late_likelihoods > 10
    a, b = in_time.estimate(), late.estimate()
    sigma = np.sqrt(np.diagonal(a.covariance))
    np.testing.assert_allclose((a.pose - b.pose) / sigma, 0.0, atol=0.02)
    np.testing.assert_allclose(a.covariance / np.outer(sigma, sigma), b.covariance / np.outer(sigma, sigma), atol=0.02)
    np.testing.assert_allclose(late.log_evidence, in_time.log_evidence, atol=0.5)


@settings(max_examples=10)
@given(order=st.permutations(range(1, 9)), dropped=st.sets(st.integers(1, 8), max_size=4))
def test_inside_the_window_the_order_of_arrival_does_not_matter(order, dropped):
    """All after the drive, in any order, some twice, some never: as the same ones in time, to 1e-6."""
    _, increments, truth, rng = drive(9, 5)
    likelihoods, prior = gaussians(truth, rng), UniformPrior(truth[0], 2.0, 0.2)
    in_time, late = (FixedLagSmoother.from_prior(0, prior, FixedLagSettings(**EXACT)) for _ in range(2))
    for increment in increments:
        late.add_odometry(increment)
    for k, increment in enumerate(increments, start=1):
        in_time.add_odometry(increment)
        if k not in dropped:
            in_time.add_likelihood(k * SECOND, likelihoods[k])
    used = [k for k in order if k not in dropped]
    for k in [*used, *used[:2]]:
        late.add_likelihood(k * SECOND, likelihoods[k])
    assert late.counts.duplicates == len(used[:2])
    np.testing.assert_allclose(late.trajectory().poses, in_time.trajectory().poses, atol=1e-6)
    np.testing.assert_allclose(late.trajectory().covariances, in_time.trajectory().covariances, atol=1e-6)


@pytest.mark.parametrize("share", [0.01, 0.3, 0.99])
def test_odometry_is_divided_for_a_likelihood_between_poses(share):
    """The parts together are the whole, covariance and all; the likelihood is where it belongs."""
    _, increments, truth, _ = drive(6, 6, step=(2.0, 0.3, 0.2))
    smoother = FixedLagSmoother(0, truth[0], np.diag([0.3, 0.3, 0.05]) ** 2, FixedLagSettings(**EXACT))
    for increment in increments:
        smoother.add_odometry(increment)
    before = smoother.trajectory()
    stamp = 2 * SECOND + round(share * SECOND)
    window = smoother.state().window.split(stamp).solved(np.inf)
    parts = [OdometryIncrement(int(window.stamps[k + 1]), window.deltas[k], window.spreads[k]) for k in range(2, 4)]
    whole = accumulate(parts)
    np.testing.assert_allclose(whole.delta, increments[2].delta, atol=1e-12)
    np.testing.assert_allclose(whole.covariance, increments[2].covariance, atol=1e-12)
    np.testing.assert_allclose(np.delete(window.poses, 3, axis=0), before.poses, atol=1e-9)
    np.testing.assert_allclose(np.delete(window.covariances, 3, axis=0), before.covariances, atol=1e-4)
    smoother.add_likelihood(stamp, GaussianLikelihood(window.poses[3] + [0.5, 0.0, 0.0], SEEN * 1e-6, GRID))
    np.testing.assert_allclose(smoother.trajectory().poses[3], window.poses[3] + [0.5, 0.0, 0.0], atol=1e-3)


def test_a_likelihood_about_another_place_counts_for_nothing():
    _, increments, truth, _ = drive(12, 7)
    grid = MapGrid(50, 50, 1.0, -12.0, -12.0)
    seen = [volume(GaussianMixture(np.ones(1), pose[None], SEEN[None]), grid, 60) for pose in truth]
    with_wrong, without = (FixedLagSmoother.from_prior(0, UniformPrior(truth[0], 2.0, 0.2)) for _ in range(2))
    fed(with_wrong, increments[:-1], seen[:-1])
    fed(without, increments[:-1], seen[:-1])
    for smoother in (with_wrong, without):
        smoother.add_odometry(increments[-1])
    away = volume(GaussianMixture(np.ones(1), truth[-1][None] + [-8.0, -9.0, 0.0], SEEN[None]), grid, 60)
    report = with_wrong.add_likelihood(11 * SECOND, away)
    np.testing.assert_allclose(report.log_evidence, np.log(0.05) - np.log(50 * 50 * 2 * np.pi), atol=0.05)
    np.testing.assert_allclose(with_wrong.estimate().pose, without.estimate().pose, atol=5e-3)


def test_what_is_too_late_or_there_already_changes_nothing():
    _, increments, truth, rng = drive(30, 8)
    likelihoods = gaussians(truth, rng)
    smoother = FixedLagSmoother.from_prior(0, UniformPrior(truth[0], 5.0, 0.3), FixedLagSettings(lag=10))
    fed(smoother, increments, likelihoods)
    window, evidence = smoother.state().window, smoother.log_evidence
    numbers = {name: array.tobytes() for name, array in arrays(window).items()}
    assert smoother.add_likelihood(0, likelihoods[0]).outcome is Outcome.TOO_LATE
    assert smoother.add_likelihood(19 * SECOND + 5, likelihoods[0]).outcome is Outcome.TOO_LATE
    assert smoother.add_likelihood(25 * SECOND, likelihoods[0]).outcome is Outcome.DUPLICATE
    assert smoother.add_odometry(increments[-1]).outcome is Outcome.DUPLICATE
    assert smoother.add_odometry(increments[3]).outcome is Outcome.TOO_LATE
    counts = smoother.counts
    assert (counts.too_late_likelihoods, counts.duplicates, counts.late_odometry) == (2, 2, 1)
    assert (counts.likelihoods, counts.odometry) == (30, 29)
    assert smoother.log_evidence == evidence
    assert {name: array.tobytes() for name, array in arrays(smoother.state().window).items()} == numbers
    assert smoother.state().window.measurements == window.measurements


def test_it_does_not_grow_with_the_drive():
    """Late, between poses, again, dropped: what is held is bounded by the lag, and nothing raises."""
    rng, truth, smoother = np.random.default_rng(9), np.zeros(3), FixedLagSmoother(0, np.zeros(3), SEEN)
    smoother.settings = FixedLagSettings(lag=12)
    covariance, held, past = np.diag([0.2, 0.15, 0.02]) ** 2, [], [truth]
    for k in range(1, 800):
        step = np.array([2.0, 0.0, 0.3])
        truth = se2.compose(truth, step)
        past.append(truth)
        delta = step + rng.multivariate_normal(np.zeros(3), covariance)
        smoother.add_odometry(OdometryIncrement(k * SECOND, delta, covariance))
        if rng.random() < 0.8:
            late = min(k, int(rng.integers(0, 20)) if rng.random() < 0.3 else 0)
            stamp = (k - late) * SECOND - int(rng.integers(0, SECOND)) * int(late > 0 and rng.random() < 0.5)
            [likelihood] = gaussians([past[k - late]], rng)
            smoother.add_likelihood(max(stamp, 0), likelihood)
            if rng.random() < 0.2:
                smoother.add_likelihood(max(stamp, 0), likelihood)
        held.append(sum(array.nbytes for array in arrays(smoother.state().window).values()))
    assert len(smoother) == 12
    assert max(held[100:]) == max(held[:100])
    counts = smoother.counts
    assert min(counts.late_likelihoods, counts.too_late_likelihoods, counts.duplicates) > 20
    assert np.abs(smoother.estimate().pose[:2] - truth[:2]).max() < 3.0


def test_bad_input_is_refused_and_changes_nothing():
    _, increments, truth, rng = drive(4, 10)
    smoother = FixedLagSmoother.from_prior(0, UniformPrior(truth[0], 5.0, 0.3))
    fed(smoother, increments[:2], gaussians(truth[:3], rng))
    [likelihood] = gaussians(truth[:1], rng)

    class Broken:
        grid = GRID

        def log_density(self, poses):
            values = np.zeros(len(poses))
            values[1:] = np.nan
            return values

    before = smoother.state()
    for word, call in {
        "expected an OdometryIncrement": lambda: smoother.add_odometry(np.zeros(3)),
        "int64": lambda: smoother.add_likelihood(1.5, likelihood),
        "up to the odometry": lambda: smoother.add_likelihood(9 * SECOND, likelihood),
        "PoseLikelihood": lambda: smoother.add_likelihood(SECOND, "likelihood"),
        "finite": lambda: smoother.add_likelihood(2 * SECOND - 5, Broken()),
        "lag": lambda: FixedLagSettings(lag=1),
        "rounds": lambda: FixedLagSettings(rounds=0),
        "refreshes": lambda: FixedLagSettings(refreshes=True),
        "outlier_probability": lambda: FixedLagSettings(outlier_probability=1.0),
        "clutter_log_density": lambda: FixedLagSettings(clutter_log_density=np.nan),
        "huber_width": lambda: FixedLagSettings(huber_width=0.0),
        "positive definite": lambda: FixedLagSmoother(0, np.zeros(3), np.zeros((3, 3))),
        "stamp": lambda: FixedLagSmoother(0.0, np.zeros(3), np.eye(3)),
    }.items():
        with pytest.raises(SkyfixError, match=word) as caught:
            call()
        assert "\n" not in str(caught.value)
    assert smoother.state() is before
