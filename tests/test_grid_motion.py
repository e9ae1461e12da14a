"""Motion on a grid: moments and whole distributions against closed forms and brute force, and no mass lost."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from fusion import (
    GaussianLikelihood,
    GridFilter,
    GridFilterSettings,
    LikelihoodVolume,
    MapGrid,
    OdometryIncrement,
    OdometryNoise,
    PoseLattice,
    UniformPrior,
    se2,
)
from fusion.grids.discrete_gaussian import planar_gaussian, planar_gaussians, symmetric_taps
from fusion.grids.grid_kernels import selling
from fusion.grids.grid_motion import GridMotion
from fusion.grids.scratch import Scratch

GRID = MapGrid(41, 61, 0.5, -15.0, -10.0)
PLAIN = GridFilterSettings(outlier_probability=1e-9, kidnap_probability=0.0)
COUPLED = np.array([[0.06, 0.01, 0.003], [0.01, 0.03, 0.004], [0.003, 0.004, 0.006]])


def increment(delta, covariance, stamp=1):
    return OdometryIncrement(stamp, np.asarray(delta, dtype=float), np.asarray(covariance, dtype=float))


def odometry(delta, seconds=0.1):
    return increment(delta, OdometryNoise().covariance(delta, seconds))


def moved(lattice, motion, mass):
    out = np.empty_like(mass)
    left = motion.apply(mass, out, Scratch())
    return out, left


def poses_of(lattice):
    return np.concatenate([lattice.poses(plane) for plane in range(lattice.shape[0])])


def variation(one, other):
    return 0.5 * np.abs(one - other).sum()


# --- kernels -------------------------------------------------------------------------------------------------------


def test_taps_have_their_variance_exactly_and_nothing_negative():
    variances = np.array([0.0, 1e-6, 0.04, 0.25, 1 / 3, 0.34, 0.5, 1.0, 2.7, 30.0])
    taps = symmetric_taps(variances).astype(float)
    n = np.arange(taps.shape[1])
    assert taps.min() >= 0.0
    np.testing.assert_allclose(taps[:, 0] + 2 * taps[:, 1:].sum(axis=1), 1.0, atol=2e-7)
    np.testing.assert_allclose(2 * taps @ n**2, variances, rtol=3e-7)
    wide = taps[-1] / np.exp(-(n**2) / 60.0)
    np.testing.assert_allclose(wide[:20] / wide[0], 1.0, rtol=1e-4)  # a wide one is the sampled Gaussian


@given(st.floats(0, np.pi), st.floats(-3, 2), st.floats(0, 2.4))
def test_selling_s_formula_adds_up_for_every_ellipse(angle, log_size, log_ratio):
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    tensor = 10.0**log_size * turn @ np.diag([1.0, 10.0**-log_ratio]) @ turn.T
    directions, variances = np.empty((1, 3, 2), dtype=np.int64), np.empty((1, 3))
    selling(tensor[None], directions, variances)
    assert variances.min() >= 0.0
    total = np.einsum("d,di,dj->ij", variances[0], directions[0], directions[0])
    np.testing.assert_allclose(total, tensor, atol=1e-9 * np.trace(tensor))


@pytest.mark.parametrize("mean", [(0.0, 0.0), (0.5, 0.5), (7.3, -4.45)])
@pytest.mark.parametrize("variance", [0.3, 0.35, 0.5, 0.7, 1.4])
@pytest.mark.parametrize("correlation", [0.0, -0.6])
def test_planar_gaussians_have_their_moments_and_are_sampled_ones_when_wide(mean, variance, correlation):
    """`variance` is the least eigenvalue; from half a cell squared on sampling alone is right to 1e-3."""
    covariance = variance / (1 - abs(correlation)) * np.array([[1.0, correlation], [correlation, 1.0]])
    cells, weights = np.empty((600, 2), dtype=np.int64), np.empty(600)
    count = planar_gaussian(np.array(mean), covariance, 1e-5, cells, weights)
    error, share = cells[:count] - np.array(mean), weights[:count]
    assert share.min() >= 0.0
    assert share.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(share @ error, 0.0, atol=1e-5)
    np.testing.assert_allclose((error * share[:, None]).T @ error, covariance, atol=1e-5)
    sampled = np.exp(-0.5 * np.einsum("ni,ij,nj->n", error, np.linalg.inv(covariance), error))
    sampled /= 2 * np.pi * np.sqrt(np.linalg.det(covariance))
    if variance >= 0.5:
        assert variation(share, sampled) < 1e-3


# --- prediction ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "motion",
    [
        odometry([1.0, 0.1, 0.03]),
        odometry([2.7, -0.4, -0.4]),
        odometry([0.0, 0.0, 0.0], seconds=1.0),
        increment([0.3, 0.2, 0.1], COUPLED),
        increment([-0.7, 0.4, 3.0], np.diag([0.5, 0.15, 0.1])),
    ],
    ids=["step", "curve", "standstill", "coupled", "turn about"],
)
def test_mean_and_covariance_of_a_step_are_those_of_the_model_at_every_heading(motion):
    """From one cell, in the body frame of that cell: exact to float32, at each of the headings."""
    lattice = PoseLattice(GRID, np.random.default_rng(0).uniform(-0.5, 0.5, (24, 2)), turned=0.123)
    operator = GridMotion.on(lattice, motion)
    poses = poses_of(operator.after)
    assert np.abs(operator.after.offsets).max() <= 0.5
    for plane in range(24):
        mass = np.zeros(lattice.shape, dtype=np.float32)
        mass[plane, 20, 30] = 1.0
        out, left = moved(lattice, operator, mass)
        assert left == 0.0
        weights = out.ravel().astype(float)
        came = np.flatnonzero(weights)
        start = lattice.at(np.array([[plane, 20, 30]]))[0]
        turn = se2.rotation(start[2])
        error = poses[came] - start
        error[:, :2] -= (turn @ motion.delta)[:2]
        error[:, 2] = se2.wrap(error[:, 2] - motion.delta[2])
        np.testing.assert_allclose(weights[came] @ error, 0.0, atol=2e-6)
        expected = turn @ motion.covariance @ turn.T
        got = (error * weights[came, None]).T @ error
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(got / scale, expected / scale, atol=3e-4 if motion.covariance[2, 2] > 0.05 else 3e-5)


def brute_force(lattice, after, motion, mass):
    """The sum over all pairs of cells of the model's density times the volume of a cell."""
    starts, ends = poses_of(lattice), poses_of(after)
    weights = mass.ravel().astype(float)
    inverse = np.linalg.inv(motion.covariance)
    peak = np.prod(lattice.cell) / np.sqrt(np.linalg.det(2 * np.pi * motion.covariance))
    result = np.zeros(len(ends))
    for at in np.flatnonzero(weights > 1e-7):
        error = se2.between(starts[at], ends) - motion.delta
        error[:, 2] = se2.wrap(error[:, 2])
        result += weights[at] * peak * np.exp(-0.5 * np.einsum("ni,ij,nj->n", error, inverse, error))
    return result.reshape(mass.shape)


def test_weights_that_were_never_set_play_no_part(monkeypatch):
    """Memory beyond the cells that are used may hold anything, signalling NaNs too."""
    lattice = PoseLattice(GRID, np.zeros((24, 2)))
    motion = increment([0.8, -0.3, 0.5], np.diag(1.5 * lattice.cell) ** 2)
    poisonings = []
    mass = np.random.default_rng(2).random(lattice.shape).astype(np.float32)
    expected, _ = moved(lattice, GridMotion.on(lattice, motion), mass)

    def poisoned(*arguments):
        sizes, cells, weights = planar_gaussians(*arguments)
        unused = np.arange(weights.shape[2]) >= sizes[:, :, None]
        poisonings.append(unused.sum())
        weights.view(np.uint64)[unused] = 0x7FF4000000000000
        return sizes, cells, weights

    monkeypatch.setattr("fusion.grids.grid_noise.planar_gaussians", poisoned)
    found, _ = moved(lattice, GridMotion.on(lattice, motion), mass)
    np.testing.assert_array_equal(found, expected)
    assert sum(poisonings) > 0


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("cells", [0.8, 1.0, 1.5, 2.2])
def test_a_step_from_single_cells_is_the_sum_over_all_pairs(cells, coupled):
    """Total variation 1e-3, mass and all, for noise of so many cells; much of the wide ones is done by lines."""
    grid, rng = MapGrid(22, 22, 0.5, -5.5, -5.5), np.random.default_rng(1)
    lattice = PoseLattice(grid, rng.uniform(-0.5, 0.5, (24, 2)), turned=-0.05)
    root = np.diag(cells * lattice.cell)
    if coupled:
        root = root @ np.array([[1.0, 0.0, 0.0], [0.3, 0.95, 0.0], [0.2, 0.2, 0.95]])
    motion = increment([0.8, -0.3, 0.5], root @ root.T)
    mass = np.zeros(lattice.shape, dtype=np.float32)
    mass[rng.integers(0, 24, 6), rng.integers(9, 13, 6), rng.integers(9, 13, 6)] = rng.random(6)
    mass /= mass.sum()
    operator = GridMotion.on(lattice, motion)
    assert (operator.noise.lines[2].max() > 0) == (cells >= 1.5)
    out, left = moved(lattice, operator, mass)
    exact = brute_force(lattice, operator.after, motion, mass)
    assert variation(out, exact) < 1e-3
    assert left == pytest.approx(1.0 - exact.sum(), abs=3e-4)


def dense(motion, covariance, mass):
    """Brute force with scipy: for every pair of planes a convolution with the density at the exact distances."""
    cell, planes = motion.before.cell, len(mass)
    deviations = np.sqrt(np.diag(covariance))
    reach, turns = int(6 * deviations[:2].max() / cell[0]) + 2, int(6 * deviations[2] / cell[2])
    down, right = np.indices((2 * reach + 1, 2 * reach + 1)) - reach
    inverse, peak = np.linalg.inv(covariance), np.prod(cell) / np.sqrt(np.linalg.det(2 * np.pi * covariance))
    result = np.zeros(mass.shape)
    for plane in range(planes):
        shifted = ndimage.shift(mass[plane].astype(float), motion.steps[plane], order=0)
        rotation = se2.rotation(motion.before.headings[plane])[:2, :2]
        for turn in range(-turns, turns + 1):
            end = (plane + turn) % planes
            row, col = motion.after.offsets[end] - motion.after.offsets[plane]
            error = np.stack([(right + col) * cell[0], -(down + row) * cell[0]], axis=-1) @ rotation
            error = np.concatenate([error, np.full((*error.shape[:2], 1), turn * cell[2])], axis=-1)
            kernel = peak * np.exp(-0.5 * np.einsum("abi,ij,abj->ab", error, inverse, error))
            result[end] += ndimage.convolve(shifted, kernel, mode="constant")
    return result


def test_predictions_and_posteriors_of_a_drive_are_those_of_dense_convolutions():
    """Three steps from a box, two places that look alike: total variation 1e-3, evidence to 1e-3 nats."""
    grid, bins = MapGrid(40, 40, 0.5, -10.0, -10.0), 32
    x, y = grid.centres()
    yaw = 2 * np.pi * np.arange(bins) / bins
    scores = np.full((40, 40, bins), -6.0)
    for x0, y0, yaw0, height in ((2.0, 0.5, 0.4, 0.0), (-3.0, -2.0, 0.9, -0.5)):
        squared = (x[None, :, None] - x0) ** 2 + (y[:, None, None] - y0) ** 2
        scores = np.logaddexp(scores, height - squared / 3.0 + (np.cos(yaw - yaw0) - 1.0) / 0.3**2)
    measurement = LikelihoodVolume.from_scores(scores, grid).with_outliers(0.05)
    settings_ = GridFilterSettings(kidnap_probability=0.0)
    started = GridFilter.from_prior(UniformPrior(np.zeros(3), 5.0, 1.0), grid, bins, settings_)
    covariance = np.array([[0.2, 0.02, 0.02], [0.02, 0.18, 0.03], [0.02, 0.03, 0.035]])
    exact = started.probabilities.astype(float)
    for step, delta in enumerate(([0.9, 0.1, 0.2], [1.1, -0.2, -0.1], [0.6, 0.3, 0.35])):
        exact = dense(GridMotion.on(started.lattice, increment(delta, covariance)), covariance, exact)
        started.predict(increment(delta, covariance, step))
        assert variation(started.probabilities, exact) < 1e-3
        exact *= np.exp(measurement.log_density(poses_of(started.lattice))).reshape(exact.shape)
        outside = started.outside_probability * np.exp(measurement.log_density([[1e6, 0.0, 0.0]])[0])
        evidence = exact.sum() + outside
        report = started.update(LikelihoodVolume.from_scores(scores, grid))
        assert report.log_evidence == pytest.approx(np.log(evidence), abs=1e-3)
        exact /= evidence
        assert variation(started.probabilities, exact) < 1e-3


@pytest.mark.parametrize(
    ("deviations", "delta"),
    [
        ((0.28, 0.28, 0.05), (1.0, 0.1, 0.03)),
        ((0.2, 0.12, 0.01), (4.0, 0.1, 0.03)),
        ((0.1, 0.06, 0.0), (1.0, 0.1, 0.03)),
    ],
    ids=["half a cell", "a step of four metres", "a metre"],
)
def test_noise_narrower_than_a_cell_moves_smooth_mass_as_cells_three_times_as_fine(deviations, delta):
    """Two steps from a density of three cells, read at the cells that coincide: total variation 1e-3 a step."""
    start = GaussianLikelihood(np.array([-1.0, 0.0, 0.1]), np.diag([1.5, 1.5, 0.2]) ** 2, GRID)
    coarse_grid, fine_grid = MapGrid(32, 40, 0.5, -10.0, -8.0), MapGrid(96, 120, 0.5 / 3, -10.0, -8.0)
    coarse = GridFilter.from_density(start, coarse_grid, 64, PLAIN)
    fine = GridFilter.from_density(start, fine_grid, 192, PLAIN)
    for step in (1, 2):
        motion = increment(delta, np.diag(deviations) ** 2, step)
        coarse.predict(motion)
        fine.predict(motion)
        apart = 3 * coarse.lattice.offsets - fine.lattice.offsets[::3]
        np.testing.assert_allclose(apart, np.rint(apart), atol=1e-9)
        shifted = np.stack(
            [
                np.roll(p, -np.rint(by).astype(int) - 1, (0, 1))
                for p, by in zip(fine.probabilities[::3], apart, strict=True)
            ]
        )
        exact = 27.0 * shifted[:, ::3, ::3]
        assert variation(coarse.probabilities, exact) < 1e-3 * step


@settings(max_examples=25)
@given(st.floats(-30, 30), st.floats(-30, 30), st.floats(-4, 4), st.floats(0, 2), st.floats(0, 2), st.floats(0, 1))
def test_no_mass_is_lost_whatever_the_motion(x, y, turn, along, across, heading):
    """Inside and outside add up to what was there; nothing is negative; nothing comes back on the other side."""
    grid = MapGrid(9, 14, 0.5, 0.0, 0.0)
    lattice = PoseLattice.of(grid, 5)
    operator = GridMotion.on(lattice, increment([x, y, turn], np.diag([along, across, heading]) ** 2))
    mass = np.random.default_rng(2).random(lattice.shape, dtype=np.float32)
    out, left = moved(lattice, operator, mass)
    assert out.min() >= 0.0 <= left
    assert out.sum(dtype=float) + left == pytest.approx(mass.sum(dtype=float), rel=3e-6)


def test_mass_leaves_at_the_edge_and_never_wraps():
    started = GridFilter.from_prior(UniformPrior(np.array([14.0, 0.0, 0.0]), 0.6, 0.05), GRID, 16, PLAIN)
    assert started.outside_probability == 0.0
    for _ in range(3):
        started.predict(increment([1.0, 0.0, 0.0], np.zeros((3, 3))))
    assert started.outside_probability == pytest.approx(1.0, abs=1e-6)
    assert started.probabilities[:, :, :20].sum() < 1e-40
    estimate = started.estimate(7, max_modes=1)
    assert estimate.lost_score == started.outside_probability
    assert np.isfinite(estimate.pose).all()


def test_headings_wrap():
    """A full turn in steps that cross the seam brings the mass back to where it was, without spreading it."""
    started = GridFilter.from_prior(UniformPrior(np.array([0.0, 0.0, 3.0]), 1.0, 0.3), GRID, 20, PLAIN)
    before, at = started.probabilities, started.estimate(0)
    for step in range(10):
        started.predict(increment([0.0, 0.0, 2 * np.pi / 10], np.zeros((3, 3)), step))
    np.testing.assert_allclose(started.probabilities, before, atol=1e-12)
    np.testing.assert_allclose(started.estimate(0).pose, at.pose, atol=1e-9)
    noisy = GridFilter.from_prior(UniformPrior(np.array([0.0, 0.0, np.pi - 0.05]), 1.0, 0.3), GRID, 20, PLAIN)
    at = noisy.estimate(0).pose
    spread = noisy.estimate(0).covariance[2, 2]
    noisy.predict(increment([0.0, 0.0, 0.02], np.diag([0.0, 0.0, 0.2]) ** 2))
    assert abs(se2.wrap(noisy.estimate(0).pose[2] - at[2] - 0.02)) < 1e-3
    assert noisy.estimate(0).covariance[2, 2] == pytest.approx(spread + 0.04, rel=1e-4)


def test_a_long_drive_in_small_steps_does_not_diffuse():
    """200 steps of a tenth of a cell, no noise: the variance stays what it was (linear splitting adds 18 cells^2)."""
    started = GridFilter.from_prior(UniformPrior(np.array([-9.0, 0.0, 0.3]), 1.0, 0.2), GRID, 36, PLAIN)
    before = started.estimate(0)
    for step in range(200):
        started.predict(increment([0.05, 0.0, 0.0], np.zeros((3, 3)), step))
    after = started.estimate(0)
    along = np.array([np.cos(0.3), np.sin(0.3)])
    moved_by = (after.pose - before.pose)[:2] @ along
    assert moved_by == pytest.approx(10.0, rel=0.02)  # the headings fan out a little
    across = np.array([-along[1], along[0]])
    fan = before.covariance[2, 2] * 10.0**2
    assert across @ after.covariance[:2, :2] @ across == pytest.approx(
        across @ before.covariance[:2, :2] @ across + fan, rel=0.03
    )
    assert along @ after.covariance[:2, :2] @ along < along @ before.covariance[:2, :2] @ along + 0.05
