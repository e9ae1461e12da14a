"""Several hypotheses: two streets alike, evidence that decides, label symmetry, merging, bad input."""

import numpy as np
import pytest

from fusion import (
    FixedLagSettings,
    FixedLagSmoother,
    GaussianLikelihood,
    GaussianMixture,
    HypothesisSettings,
    HypothesisSmoother,
    LikelihoodVolume,
    MapGrid,
    OdometryIncrement,
    SkyfixError,
)

SECOND = 1_000_000_000
COVARIANCE = np.diag([0.15, 0.1, 0.01]) ** 2
START = np.diag([2.0, 2.0, 0.05]) ** 2
STREETS = (0.0, 30.0)
GRID = MapGrid(60, 60, 1.0, -30.0, -15.0)
BINS = 36


def streets(at, shares, rng, along=3.0, across=1.2):
    """Two ridges 30 m apart, heading east, as a network sees them: the same error on both, and speckle of its own."""
    error = rng.normal(0.0, [0.8, 0.4])
    grid = MapGrid(GRID.rows, GRID.cols, 1.0, np.floor(at[0]) - 30.0, GRID.y0)
    x, y = grid.centres()
    yaw = np.arange(BINS) * 2.0 * np.pi / BINS
    turned = (yaw + np.pi) % (2.0 * np.pi) - np.pi
    density = np.zeros((grid.rows, grid.cols, BINS))
    for street, share in zip(STREETS, shares, strict=True):
        rows = np.exp(-0.5 * ((y - street - error[1]) / across) ** 2)
        cols = np.exp(-0.5 * ((x - at[0] - error[0]) / along) ** 2)
        density += share * rows[:, None, None] * cols[None, :, None] * np.exp(-0.5 * (turned / 0.15) ** 2)
    return LikelihoodVolume.from_scores(np.log(density + 1e-9) + rng.normal(0.0, 0.1, density.shape), grid)


def starts(order=(0, 1), weights=(0.5, 0.5), covariance=START):
    means = np.array([[0.0, STREETS[k], 0.0] for k in order])
    return GaussianMixture(np.array(weights), means, np.array([covariance] * 2))


def driven(tracker, seed, true_street, undecided=20, told=4):
    """Along both streets with nothing to choose by, then some frames that favour one; weights after each frame."""
    rng, at, history = np.random.default_rng(seed), np.array([0.0, STREETS[true_street], 0.0]), []
    for k in range(1, undecided + told + 1):
        at = at + [1.5, 0.0, 0.0]
        delta = np.array([1.5, 0.0, 0.0]) + rng.multivariate_normal(np.zeros(3), COVARIANCE)
        tracker.add_odometry(OdometryIncrement(k * SECOND, delta, COVARIANCE))
        shares = [0.5, 0.5]
        if k > undecided:
            shares = [0.2, 0.2]
            shares[true_street] = 0.8
        tracker.add_likelihood(k * SECOND, streets(at, shares, rng))
        history.append({round(one.pose[1] / 30.0): one.weight for one in tracker.hypotheses()})
    return at, history


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("true_street", [0, 1])
def test_two_streets_are_both_kept_until_evidence_comes(seed, true_street):
    """Streets 30 m apart: weights of 0.35 to 0.65 while nothing tells them apart, then 0.99 for the right one."""
    tracker = HypothesisSmoother(0, starts())
    at, history = driven(tracker, seed, true_street)
    for weights in history[:20]:
        assert sorted(weights) == [0, 1]
        assert all(0.35 < weight < 0.65 for weight in weights.values())
    assert history[-1][true_street] >= 0.99
    estimate = tracker.estimate(max_modes=2)
    assert np.hypot(*(estimate.modes.means[0] - at)[:2]) < 1.5
    assert estimate.modes.weights[0] >= 0.99


def test_names_do_not_matter():
    """The starts the other way round: the weights the other way round, to the last digits."""
    one, other = HypothesisSmoother(0, starts()), HypothesisSmoother(0, starts((1, 0)))
    driven(one, 3, 0, undecided=8, told=1)
    driven(other, 3, 0, undecided=8, told=1)
    np.testing.assert_allclose(one.weights, other.weights[::-1], rtol=1e-9)
    for a, b in zip(one.hypotheses(), other.hypotheses()[::-1], strict=True):
        np.testing.assert_allclose(a.pose, b.pose, atol=1e-9)
    np.testing.assert_allclose(one.log_evidence, other.log_evidence, rtol=1e-9)


def test_a_wide_hypothesis_does_not_take_the_other_streets_mass():
    """One so wide that its window reaches the other street, where another one is known: each has its own street, and
    the weights are those of the prior's densities there, in closed form."""
    covariances = np.array([np.diag([2.0, 14.0, 0.05]) ** 2, START])
    means = np.array([[0.0, STREETS[0], 0.0], [0.0, STREETS[1], 0.0]])
    tracker = HypothesisSmoother(0, GaussianMixture(np.array([0.5, 0.5]), means, covariances))
    driven(tracker, 4, 0, undecided=6, told=0)
    lower, upper = tracker.hypotheses()
    assert abs(lower.pose[1] - STREETS[0]) < 1.5
    assert abs(upper.pose[1] - STREETS[1]) < 1.5
    assert np.sqrt(lower.covariance[1, 1]) < 1.0
    heights = 1.0 / np.hypot([14.0, 2.0], 1.2)
    np.testing.assert_allclose(tracker.weights, heights / heights.sum(), atol=0.03)


def test_hypotheses_that_see_the_same_mass_become_one():
    mean = np.array([[0.0, -2.5, 0.0], [1.0, 2.5, 0.0]])
    tracker = HypothesisSmoother(0, GaussianMixture(np.array([0.3, 0.7]), mean, np.array([START, START])))
    assert len(tracker) == 2
    _, history = driven(tracker, 5, 0, undecided=6, told=0)
    assert len(tracker) == 1
    assert history[-1] == {0: pytest.approx(1.0)}


def test_with_one_hypothesis_it_is_the_fixed_lag_smoother():
    start = GaussianMixture(np.array([0.4]), np.zeros((1, 3)), START[None])
    tracker, smoother = HypothesisSmoother(0, start), FixedLagSmoother(0, np.zeros(3), START)
    driven(tracker, 6, 0, undecided=3, told=0)
    rng = np.random.default_rng(6)
    for k in range(1, 4):
        delta = np.array([1.5, 0.0, 0.0]) + rng.multivariate_normal(np.zeros(3), COVARIANCE)
        smoother.add_odometry(OdometryIncrement(k * SECOND, delta, COVARIANCE))
        smoother.add_likelihood(k * SECOND, streets(np.array([1.5 * k, 0.0]), [0.5, 0.5], rng))
    np.testing.assert_allclose(tracker.estimate().pose, smoother.estimate().pose, atol=1e-12)
    np.testing.assert_allclose(tracker.log_evidence, smoother.log_evidence)


def test_moments_are_those_of_the_mixture_with_headings_on_the_circle():
    means = np.array([[0.0, 0.0, 3.1], [10.0, 0.0, -3.1]])
    mixture = GaussianMixture(np.array([0.25, 0.75]), means, np.array([START, 2.0 * START]))
    estimate = HypothesisSmoother(0, mixture).estimate(max_modes=5)
    np.testing.assert_allclose(estimate.pose[:2], [7.5, 0.0])
    off = np.array([3.1, -3.1])
    heading = np.arctan2([0.25, 0.75] @ np.sin(off), [0.25, 0.75] @ np.cos(off))
    np.testing.assert_allclose(estimate.pose[2], heading, atol=1e-9)
    np.testing.assert_allclose(estimate.covariance[0, 0], 4.0 * 1.75 + 0.25 * 7.5**2 + 0.75 * 2.5**2)
    np.testing.assert_allclose(estimate.modes.weights, [0.75, 0.25])


def test_late_twice_and_bad_is_refused_for_all_alike():
    limits = FixedLagSettings(lag=5)
    tracker = HypothesisSmoother(0, starts(), smoother_settings=limits)
    driven(tracker, 7, 0, undecided=8, told=0)
    before = tracker.state()
    rng = np.random.default_rng(0)
    likelihood = streets(np.zeros(3), [0.5, 0.5], rng)
    for stamp in (0, 8 * SECOND):
        tracker.add_likelihood(stamp, likelihood)
    assert (tracker.counts.too_late_likelihoods, tracker.counts.duplicates) == (1, 1)
    np.testing.assert_array_equal(tracker.state().log_weights, before.log_weights)
    assert [one.window for one in tracker.state().smoothers] == [one.window for one in before.smoothers]
    far = GaussianLikelihood(np.zeros(3), START, GRID)
    for word, call in {
        "int64": lambda: tracker.add_likelihood(0.5, likelihood),
        "up to the odometry": lambda: tracker.add_likelihood(99 * SECOND, far),
        "OdometryIncrement": lambda: tracker.add_odometry(None),
        "least_share": lambda: HypothesisSettings(least_share=1.0),
        "merge_distance": lambda: HypothesisSettings(merge_distance=3.0),
    }.items():
        with pytest.raises(SkyfixError, match=word) as caught:
            call()
        assert "\n" not in str(caught.value)
    tracker.restore(before)
    assert tracker.counts.duplicates == 0
