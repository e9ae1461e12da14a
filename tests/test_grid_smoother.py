"""The grid smoother: an exact adjoint, and brute-force enumeration of a tiny hidden Markov model."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from fusion import (
    GaussianLikelihood,
    GridFilter,
    GridFilterSettings,
    LikelihoodVolume,
    MapGrid,
    OdometryIncrement,
    SkyfixError,
    UniformPrior,
    se2,
    smooth_on_grid,
)
from fusion.grid_smoother import _normalised
from fusion.grids.grid_motion import GridMotion
from fusion.grids.pose_lattice import PoseLattice
from fusion.grids.scratch import Scratch

TINY = MapGrid(3, 4, 1.0, -2.0, -1.5)
HEADINGS = 3
COVARIANCE = np.array([[0.3, 0.05, 0.1], [0.05, 0.2, 0.15], [0.1, 0.15, 0.5]])


def increment(stamp, delta, covariance=COVARIANCE):
    return OdometryIncrement(stamp, np.asarray(delta, dtype=float), covariance)


def measured(seed, grid=TINY, bins=HEADINGS):
    rng = np.random.default_rng(seed)
    return LikelihoodVolume.from_scores(rng.normal(0, 1.5, (grid.rows, grid.cols, bins)), grid)


def matrix(motion):
    """The operator, column by column: mass at every end from each start."""
    shape = motion.before.shape
    columns = []
    for at in range(int(np.prod(shape))):
        mass, out = np.zeros(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
        mass.ravel()[at] = 1.0
        motion.apply(mass, out, Scratch())
        columns.append(out.ravel().astype(float))
    return np.transpose(columns)


@pytest.mark.parametrize("covariance", [COVARIANCE, np.diag([0.9, 0.1, 0.0]), np.zeros((3, 3))])
def test_the_adjoint_is_the_adjoint(covariance):
    """<A x, y> = <x, A' y> on grids where much leaves over the edge."""
    rng = np.random.default_rng(0)
    for grid, bins in ((MapGrid(17, 23, 0.5, 0.0, 0.0), 12), (TINY, HEADINGS), (MapGrid(1, 9, 0.4, 0.0, 0.0), 1)):
        lattice = PoseLattice(grid, rng.uniform(-0.5, 0.5, (bins, 2)), 0.3)
        motion = GridMotion.on(lattice, increment(1, [1.3, -0.6, 0.8], covariance))
        x, y = (rng.random(lattice.shape, dtype=np.float32) for _ in range(2))
        moved, back = np.empty_like(x), np.empty_like(x)
        motion.apply(x, moved, Scratch())
        motion.adjoint(y, back, Scratch())
        left, right = (np.vdot(a.astype(float), b.astype(float)) for a, b in ((moved, y), (x, back)))
        assert left == pytest.approx(right, rel=1e-6)


def tiny_drive():
    """Three nodes, the middle one not measured, on 36 cells; an uneven start."""
    start = GridFilter(np.random.default_rng(1).random((HEADINGS, 3, 4)), TINY)
    increments = [increment(20, [0.7, 0.2, 0.4]), increment(30, [-0.4, 0.3, -0.9])]
    return start, increments, [measured(2), None, measured(3)]


def enumerated(start, increments, likelihoods, temperatures):
    """Probability of every path (36, 36, 36) together with the measurements."""
    lattices, operators = [start.lattice], []
    for one in increments:
        motion = GridMotion.on(lattices[-1], one)
        operators.append(matrix(motion))
        lattices.append(motion.after)
    densities = []
    for lattice, likelihood, temperature in zip(lattices, likelihoods, temperatures, strict=True):
        poses = np.concatenate([lattice.poses(plane) for plane in range(HEADINGS)])
        used = None if likelihood is None else likelihood.tempered(temperature).with_outliers(0.05)
        densities.append(np.ones(len(poses)) if used is None else np.exp(used.log_density(poses)))
    first = start.probabilities.ravel().astype(float)
    joint = np.empty((36, 36, 36))
    for a, b, c in product(range(36), repeat=3):
        joint[a, b, c] = first[a] * densities[0][a] * operators[0][b, a] * densities[1][b]
        joint[a, b, c] *= operators[1][c, b] * densities[2][c]
    return joint, lattices


def test_marginals_and_evidence_are_those_of_enumerating_every_path():
    start, increments, likelihoods = tiny_drive()
    temperatures = [1.0, 1.0, 1.7]
    joint, lattices = enumerated(start, increments, likelihoods, temperatures)
    result = smooth_on_grid(start, 10, increments, likelihoods, temperatures)
    assert result.log_evidence == pytest.approx(np.log(joint.sum()), abs=1e-5)
    for node, (marginal, axes) in enumerate(zip(result.marginals, ((1, 2), (0, 2), (0, 1)), strict=True)):
        expected = joint.sum(axis=axes) / joint.sum()
        np.testing.assert_allclose(marginal.ravel(), expected, atol=2e-6)
        poses = np.concatenate([lattices[node].poses(plane) for plane in range(HEADINGS)])
        mean, _ = se2.weighted_mean_and_covariance(poses, expected)
        np.testing.assert_allclose(result.trajectory.poses[node], mean, atol=1e-4)
    np.testing.assert_array_equal(result.trajectory.stamp_ns, [10, 20, 30])
    assert np.linalg.eigvalsh(result.trajectory.covariances).min() > 0.0


def test_paths_are_drawn_as_often_as_they_are_probable():
    """6,000 paths over 36^3: every pair of neighbouring nodes agrees within sampling noise (5 deviations)."""
    start, increments, likelihoods = tiny_drive()
    joint, lattices = enumerated(start, increments, likelihoods, [1.0] * 3)
    joint /= joint.sum()
    count = 6000
    paths = smooth_on_grid(start, 10, increments, likelihoods).sample_paths(count, 4)
    assert paths.shape == (count, 3, 3)
    index = []
    for node, lattice in enumerate(lattices):
        poses = np.concatenate([lattice.poses(plane) for plane in range(HEADINGS)])
        off = paths[:, node, None] - poses
        off[..., 2] = se2.wrap(off[..., 2])
        distance = np.abs(off).sum(axis=2)
        assert distance.min(axis=1).max() < 1e-9
        index.append(distance.argmin(axis=1))
    for a, b, axis in ((0, 1, 2), (1, 2, 0), (0, 2, 1)):
        found = np.zeros((36, 36))
        np.add.at(found, (index[a], index[b]), 1.0 / count)
        expected = joint.sum(axis=axis)
        noise = np.sqrt(expected * (1 - expected) / count)
        assert (np.abs(found - expected) < 5 * noise + 2.0 / count).all()
        assert 0.5 * np.abs(found - expected).sum() < 1.5 * 0.4 * noise.sum()  # mean |N(0, 1)| / 2 = 0.4
    again = smooth_on_grid(start, 10, increments, likelihoods).sample_paths(count, 4)
    np.testing.assert_array_equal(paths, again)


def test_a_marginal_whose_filter_and_future_hardly_agree_is_that_of_their_product():
    """Where one knows best the other's mass is far below the smallest single-precision number."""
    mass, message = (np.exp(-0.5 * (np.arange(40.0) - at) ** 2).astype(np.float32) for at in (13.0, 26.0))
    found = _normalised(mass, message)
    exact = mass.astype(float) * message.astype(float)
    np.testing.assert_allclose(found, exact / exact.sum(), rtol=1e-6, atol=1e-30)
    assert found.sum() == pytest.approx(1.0, abs=1e-6)


def test_the_last_marginal_is_the_filter_s_and_earlier_ones_know_more():
    """One late measurement tells two places apart: the filter could not know at the start, the smoother does."""
    grid = MapGrid(24, 48, 0.5, -12.0, -6.0)
    x, y = grid.centres()
    yaw = 2 * np.pi * np.arange(24) / 24
    heading = (np.cos(yaw) - 1.0) / 0.3**2
    places = [-0.5 * ((x[None, :, None] - x0) ** 2 + y[:, None, None] ** 2) + heading for x0 in (-7.0, 5.0)]
    both = LikelihoodVolume.from_scores(np.logaddexp(*places), grid)
    later = GaussianLikelihood(np.array([7.0, 0.0, 0.0]), np.diag([1.0, 1.0, 0.3]) ** 2, grid)
    noise = np.diag([0.1, 0.1, 0.03]) ** 2
    settings = GridFilterSettings(kidnap_probability=0.0)
    start = GridFilter.from_prior(UniformPrior(np.zeros(3), 11.0, np.pi), grid, 24, settings)
    increments = [increment(step, [1.0, 0.0, 0.0], noise) for step in (1, 2)]
    result = smooth_on_grid(start, 0, increments, [both, None, later])
    started = GridFilter.from_prior(UniformPrior(np.zeros(3), 11.0, np.pi), grid, 24, settings)
    evidence = started.update(both).log_evidence
    torn = started.estimate(0)
    for one in increments:
        started.predict(one)
    evidence += started.update(later).log_evidence
    last = started.estimate(2)
    np.testing.assert_allclose(result.trajectory.poses[-1], last.pose, atol=5e-3)
    assert result.log_evidence == pytest.approx(evidence, abs=5e-3)
    assert torn.covariance[0, 0] > 20.0
    assert result.trajectory.covariances[0, 0, 0] < 3.0
    assert result.trajectory.poses[0, 0] == pytest.approx(5.0, abs=0.5)
    np.testing.assert_allclose([marginal.sum() for marginal in result.marginals], 1.0, atol=1e-5)


def test_bad_input_is_one_line():
    start, increments, likelihoods = tiny_drive()
    gone = [increment(20, [50.0, 0.0, 0.0]), increments[1]]
    result = smooth_on_grid(start, 10, increments, likelihoods)
    for word, call in {
        "grid smoother: expected 3 likelihoods": lambda: smooth_on_grid(start, 10, increments, likelihoods[:2]),
        "got 3 and 1": lambda: smooth_on_grid(start, 10, increments, likelihoods, [1.0]),
        "stamps: expected strictly increasing": lambda: smooth_on_grid(start, 25, increments, likelihoods),
        "increment: expected one that stays": lambda: smooth_on_grid(start, 10, gone, likelihoods),
        "temperature: expected > 0": lambda: smooth_on_grid(start, 10, increments, likelihoods, [0.0, 1.0, 1.0]),
        "paths: expected a count >= 1": lambda: result.sample_paths(0, 1),
    }.items():
        with pytest.raises(SkyfixError, match=word) as caught:
            call()
        assert "\n" not in str(caught.value)
