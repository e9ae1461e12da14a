"""The incremental smoother against the offline one, with loops, fixes, lateness, and bad input."""

import numpy as np
import pytest
from test_fixed_lag import GRID, fed, gaussians
from test_graph_likelihoods import CERTAIN, SECOND, SEEN, drive, rough, volume
from test_graph_other_factors import TIGHT, circle

from fusion import (
    AbsoluteFix,
    FixedLagSettings,
    FixedLagSmoother,
    GaussianLikelihood,
    GaussianMixture,
    IncrementalSettings,
    IncrementalSmoother,
    LoopClosure,
    MapGrid,
    OdometryIncrement,
    Outcome,
    SkyfixError,
    SmootherSettings,
    UniformPrior,
    se2,
    smooth,
)

EXACT = IncrementalSettings(outlier_probability=0.0, huber_width=np.inf)


def in_sigmas(found, offline):
    """How far poses are from the offline smoother's, and the variances as shares of its."""
    sigma = np.sqrt(np.diagonal(offline.covariances, axis1=1, axis2=2))
    off = found.poses - offline.poses
    off[:, 2] = se2.wrap(off[:, 2])
    return off / sigma, np.diagonal(found.covariances, axis1=1, axis2=2) / sigma**2


def test_with_gaussians_it_is_the_offline_smoother():
    """To a centimetre, a fiftieth of a standard deviation: a site is not turned with its pose before it is stale."""
    stamps, increments, truth, rng = drive(60, 1)
    likelihoods, prior = gaussians(truth, rng), UniformPrior(truth[0], 5.0, 0.3)
    smoother = IncrementalSmoother.from_prior(0, prior, EXACT)
    fed(smoother, increments, likelihoods)
    offline = smooth(stamps, increments, likelihoods, prior, rough(stamps, truth), CERTAIN).trajectory
    found = smoother.trajectory()
    np.testing.assert_array_equal(found.stamp_ns, stamps)
    np.testing.assert_allclose(found.poses, offline.poses, atol=1e-2)
    np.testing.assert_allclose(in_sigmas(found, offline)[1], 1.0, atol=0.01)
    np.testing.assert_allclose(smoother.estimate().pose, found.poses[-1])
    np.testing.assert_allclose(smoother.estimate(1).modes.covariances[0], found.covariances[-1])


def test_with_whole_likelihoods_too_it_is_the_offline_smoother():
    """Two peaks each, and outliers; in time to a tenth of a standard deviation, and from the newest to the oldest, so
    that every site but the first is found again from what comes late, closer still."""
    stamps, increments, truth, rng = drive(14, 2, step=(1.5, 0.0, 0.05))
    grid, likelihoods = MapGrid(40, 40, 1.0, -8.0, -10.0), []
    for pose in truth:
        at = pose + rng.multivariate_normal(np.zeros(3), SEEN)
        both = GaussianMixture(np.array([0.6, 0.4]), np.array([at, at + [0.0, 9.0, 0.0]]), np.array([SEEN, SEEN]))
        likelihoods.append(volume(both, grid, 60))
    prior = UniformPrior(truth[0], 2.0, 0.3)
    settings = SmootherSettings(odometry_kernel="none")
    offline = smooth(stamps, increments, likelihoods, prior, rough(stamps, truth), settings).trajectory
    smoother = IncrementalSmoother.from_prior(0, prior, IncrementalSettings(huber_width=np.inf))
    fed(smoother, increments, likelihoods)
    off, widths = in_sigmas(smoother.trajectory(), offline)
    np.testing.assert_allclose(off, 0.0, atol=0.1)
    np.testing.assert_allclose(widths, 1.0, atol=0.1)
    late = IncrementalSmoother.from_prior(0, prior, IncrementalSettings(newest=1, huber_width=np.inf))
    for increment in increments:
        late.add_odometry(increment)
    for k in reversed(range(14)):
        late.add_likelihood(k * SECOND, likelihoods[k])
    off, widths = in_sigmas(late.trajectory(), offline)
    np.testing.assert_allclose(off, 0.0, atol=0.03)
    np.testing.assert_allclose(widths, 1.0, atol=2e-3)


@pytest.mark.parametrize("likelihoods", [False, True])
def test_loops_and_fixes_that_join_online_do_what_they_do_offline(likelihoods):
    """A drive around, its loop closed at the end, a wrong closure and a wrong fix among the right ones."""
    stamps, increments, truth, start, prior = circle(seed=3)
    rng, spread = np.random.default_rng(7), np.diag([0.5, 0.4]) ** 2
    seen = [None] * 40
    if likelihoods:
        seen = [one if k % 5 == 0 else None for k, one in enumerate(gaussians(truth, rng))]
    others = [
        LoopClosure(0, 39, se2.between(truth[0], truth[39]), TIGHT),
        LoopClosure(5, 30, np.zeros(3), TIGHT),
        AbsoluteFix(20, truth[20, :2] + rng.normal(0.0, 0.4, 2), spread),
        AbsoluteFix(25, truth[25, :2] + 40.0, spread),
    ]
    smoother = IncrementalSmoother.from_prior(0, prior, EXACT)
    for k in range(40):
        if k:
            smoother.add_odometry(increments[k - 1])
        if seen[k] is not None:
            smoother.add_likelihood(k * SECOND, seen[k])
        for other in others:
            if max(other.nodes) == k:
                smoother.add(other)
    offline = smooth(stamps, increments, seen, prior, start, CERTAIN, others)
    off, _ = in_sigmas(smoother.trajectory(), offline.trajectory)
    order = np.argsort([max(other.nodes) for other in others], kind="stable")
    np.testing.assert_allclose(smoother.weights(), offline.other_weights[order], atol=0.05)
    assert offline.other_weights[[1, 3]].max() < 0.05
    np.testing.assert_allclose(off, 0.0, atol=0.15)


def test_a_loop_takes_drift_away_that_the_map_did_not_see():
    """Likelihoods at the start alone: the drive comes back metres off, and the closure brings it home."""
    _, increments, truth, _, prior = circle(seed=4)
    smoother = IncrementalSmoother.from_prior(0, prior)
    for increment in increments:
        smoother.add_odometry(increment)
    before = np.hypot(*(smoother.trajectory().poses - truth)[:, :2].T)
    assert smoother.add(LoopClosure(0, 39, se2.between(truth[0], truth[39]), TIGHT)) == 0
    after = np.hypot(*(smoother.trajectory().poses - truth)[:, :2].T)
    assert after[-1] < 0.3 < 1.0 < before[-1]
    assert after.mean() < 0.6 * before.mean()


def test_however_late_a_likelihood_comes_it_counts_in_full():
    """Any order of arrival, between poses too; to 0.05 standard deviations, and the evidence to half a nat."""
    _, increments, truth, rng = drive(50, 4)
    likelihoods, prior = gaussians(truth, rng), UniformPrior(truth[0], 5.0, 0.3)
    in_time, late = (IncrementalSmoother.from_prior(0, prior, EXACT) for _ in range(2))
    fed(in_time, increments, likelihoods)
    for increment in increments:
        late.add_odometry(increment)
    for k in rng.permutation(50):
        assert late.add_likelihood(int(k) * SECOND, likelihoods[k]).outcome is Outcome.USED
    assert late.counts.likelihoods == 50
    assert late.counts.late_likelihoods > 30
    off, widths = in_sigmas(late.trajectory(), in_time.trajectory())
    np.testing.assert_allclose(off, 0.0, atol=0.05)
    np.testing.assert_allclose(widths, 1.0, atol=0.02)
    np.testing.assert_allclose(late.log_evidence, in_time.log_evidence, atol=0.5)


@pytest.mark.parametrize("share", [0.01, 0.3, 0.99])
def test_odometry_is_divided_for_a_likelihood_between_poses(share):
    """The other poses stay what they were for a likelihood that says nothing; one that is sure is where it belongs.

    Numbers of poses count the new one from then on.
    """
    _, increments, truth, _ = drive(6, 6, step=(2.0, 0.3, 0.2))
    smoother = IncrementalSmoother(0, truth[0], np.diag([0.3, 0.3, 0.05]) ** 2, EXACT)
    for increment in increments:
        smoother.add_odometry(increment)
    before, stamp = smoother.trajectory(), 2 * SECOND + round(share * SECOND)
    smoother.add_likelihood(stamp, GaussianLikelihood(truth[2], SEEN * 1e6, GRID))
    after = smoother.trajectory()
    assert after.stamp_ns[3] == stamp
    np.testing.assert_allclose(np.delete(after.poses, 3, axis=0), before.poses, atol=2e-3)
    np.testing.assert_allclose(np.delete(after.covariances, 3, axis=0), before.covariances, atol=1e-3)
    [between] = before.interpolate([stamp])
    np.testing.assert_allclose(after.poses[3], between, atol=2e-3)
    smoother.add(AbsoluteFix(3, between[:2] + [0.3, 0.0], np.eye(2) * 1e-6))
    np.testing.assert_allclose(smoother.trajectory().poses[3, :2], between[:2] + [0.3, 0.0], atol=2e-2)
    assert smoother.weights()[0] > 0.9  # the residual of the pose that it was put on


def test_a_registration_that_failed_is_held_against_by_hubers_loss():
    """As the fixed-lag smoother with the same loss and a lag longer than the drive."""
    _, increments, truth, rng = drive(30, 12)
    bad = increments[15]
    increments[15] = OdometryIncrement(bad.stamp_ns, bad.delta + [4.0, 1.5, 0.2], bad.covariance)
    likelihoods, prior = gaussians(truth, rng), UniformPrior(truth[0], 5.0, 0.3)
    smoother = IncrementalSmoother.from_prior(0, prior, IncrementalSettings(outlier_probability=0.0))
    lagged = FixedLagSmoother.from_prior(0, prior, FixedLagSettings(outlier_probability=0.0))
    fed(smoother, increments, likelihoods)
    fed(lagged, increments, likelihoods)
    np.testing.assert_allclose(smoother.trajectory().poses, lagged.trajectory().poses, atol=0.03)


def test_what_was_there_already_or_before_the_drive_changes_nothing():
    _, increments, truth, rng = drive(10, 8)
    likelihoods = gaussians(truth, rng)
    smoother = IncrementalSmoother.from_prior(0, UniformPrior(truth[0], 5.0, 0.3))
    fed(smoother, increments, likelihoods)
    before, evidence = smoother.trajectory(), smoother.log_evidence
    assert smoother.add_likelihood(-5, likelihoods[0]).outcome is Outcome.TOO_LATE
    assert smoother.add_likelihood(4 * SECOND, likelihoods[0]).outcome is Outcome.DUPLICATE
    assert smoother.add_odometry(increments[-1]).outcome is Outcome.DUPLICATE
    assert smoother.add_odometry(OdometryIncrement(SECOND // 2, np.zeros(3), SEEN)).outcome is Outcome.TOO_LATE
    counts = smoother.counts
    assert (counts.too_late_likelihoods, counts.duplicates, counts.late_odometry) == (1, 2, 1)
    assert (counts.likelihoods, counts.odometry, len(smoother)) == (10, 9, 10)
    assert smoother.log_evidence == evidence
    np.testing.assert_array_equal(smoother.trajectory().poses, before.poses)


def test_bad_input_is_refused_and_changes_nothing(monkeypatch):
    _, increments, truth, rng = drive(5, 10)
    smoother = IncrementalSmoother.from_prior(0, UniformPrior(truth[0], 5.0, 0.3))
    fed(smoother, increments[:3], gaussians(truth[:4], rng))
    [likelihood] = gaussians(truth[:1], rng)

    class Broken:
        grid = GRID

        def log_density(self, poses):
            values = np.zeros(len(poses))
            values[1:] = np.nan
            return values

    before = smoother.trajectory()
    unsolvable = AbsoluteFix(2, np.zeros(2), np.eye(2))
    monkeypatch.setattr(AbsoluteFix, "factor", lambda self, widening, key: broken_factor(key))
    for word, call in {
        "expected an OdometryIncrement": lambda: smoother.add_odometry(np.zeros(3)),
        "int64": lambda: smoother.add_likelihood(1.5, likelihood),
        "up to the odometry": lambda: smoother.add_likelihood(9 * SECOND, likelihood),
        "PoseLikelihood": lambda: smoother.add_likelihood(SECOND, "likelihood"),
        "finite": lambda: smoother.add_likelihood(2 * SECOND - 5, Broken()),
        "different nodes in": lambda: smoother.add(LoopClosure(1, 4, np.zeros(3), TIGHT)),
        "nodes in": lambda: smoother.add(LoopClosure(1, 1, np.zeros(3), TIGHT)),
        "solvable graph": lambda: smoother.add(unsolvable),
        "newest": lambda: IncrementalSettings(newest=0),
        "outlier_probability": lambda: IncrementalSettings(outlier_probability=1.0),
        "clutter_log_density": lambda: IncrementalSettings(clutter_log_density=np.nan),
        "huber_width": lambda: IncrementalSettings(huber_width=0.0),
        "positive definite": lambda: IncrementalSmoother(0, np.zeros(3), np.zeros((3, 3))),
    }.items():
        with pytest.raises(SkyfixError, match=word) as caught:
            call()
        assert "\n" not in str(caught.value)
    after = smoother.trajectory()
    np.testing.assert_array_equal(after.stamp_ns, before.stamp_ns)
    np.testing.assert_allclose(after.poses, before.poses, atol=2e-3)
    assert len(smoother.weights()) == 0
    smoother.add_odometry(increments[3])
    smoother.add_likelihood(4 * SECOND, gaussians(truth[4:], rng)[0])
    assert np.abs(smoother.estimate().pose[:2] - truth[4, :2]).max() < 2.0


def broken_factor(key):
    """A factor whose noise is not a number, as GTSAM takes it."""
    import gtsam

    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([1.0, 1.0, 1.0]))
    return gtsam.PriorFactorPose2(key, gtsam.Pose2(np.nan, 0.0, 0.0), noise)
