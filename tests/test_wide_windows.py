"""Likelihoods under wide windows: all of the circle, whichever way the window looks, and what lies beyond the cells."""

import numpy as np
import pytest

from fusion import LikelihoodVolume, MapGrid, OdometryIncrement, SmootherSettings, Trajectory, UniformPrior, smooth
from fusion.graph.likelihood_bank import LikelihoodBank
from fusion.graph.patch import LikelihoodPatch, patch_of
from fusion.graph.window_lattice import REACH

BINS, FLOOR, UNIFORM = 64, -14.0, -9.0
BIN = 2.0 * np.pi / BINS
GRID = MapGrid(14, 12, 0.5, 20.0, -3.0)
YAWS = [0.0, 1e-9, -1e-9, 0.5 * BIN, 0.05, 1.5, 3.1, np.pi, -np.pi, -1.5, -0.05, 2.0 * np.pi, 7.0]
TILT = np.array([[1.0, 0.0, 0.0], [0.4, 0.9, 0.0], [-0.3, 0.2, 0.9]])


def patch(bins, first_bin, seed=0):
    """Cells without any smoothness."""
    values = np.random.default_rng(seed).uniform(-12.0, 2.0, (GRID.rows, GRID.cols, bins)).astype(np.float32)
    return LikelihoodPatch(values, GRID, first_bin, BINS, FLOOR, UNIFORM)


def under_one(one, centre, root, outlier):
    """What the bank finds."""
    found = LikelihoodBank([one], outlier).windowed(np.array(centre)[None], (root @ root.T)[None])
    return found.log_mass[0], found.means[0], found.spreads[0]


def by_summing(one, centre, root, outlier):
    """ln mass, mean, covariance: every cell and every image of the circle, and the floor for the rest of the window."""
    x, y, yaw = one.first_centre
    rows, cols, bins = one.log_prob.shape
    turns = 2.0 * np.pi * np.arange(-12, 13)
    where = np.meshgrid(
        y - 0.5 * np.arange(rows), x + 0.5 * np.arange(cols), yaw + BIN * np.arange(bins), turns, indexing="ij"
    )
    poses = np.stack([where[1], where[0], where[2] + where[3]], axis=-1)
    u = (poses - centre) @ np.linalg.inv(root).T
    square = (u**2).sum(axis=-1)
    window = 0.25 * BIN * np.exp(-0.5 * square) / ((2.0 * np.pi) ** 1.5 * np.linalg.det(root))
    beyond = (1.0 - outlier) * np.exp(FLOOR) + outlier * np.exp(UNIFORM)
    above = (1.0 - outlier) * (np.exp(one.log_prob.astype(np.float64)) - np.exp(FLOOR))
    weight = np.where(square <= REACH**2, window, 0.0) * above[..., None]
    total = weight.sum() + beyond
    mean = np.einsum("rcki,rckia->a", weight, u) / total
    spread = (np.einsum("rcki,rckia,rckib->ab", weight, u, u) + beyond * np.eye(3)) / total
    return np.log(total), mean, spread - np.outer(mean, mean)


@pytest.mark.parametrize("yaw", YAWS)
@pytest.mark.parametrize(("bins", "first_bin"), [(BINS, 0), (BINS, 40), (50, 60), (20, 55), (20, 0)])
@pytest.mark.parametrize("heading", [0.25, 1.0, 3.0])
def test_moments_are_sums_over_cells_and_images(bins, first_bin, yaw, heading):
    one, root = patch(bins, first_bin), np.diag([1.2, 1.1, heading]) @ TILT
    centre = np.array([22.6, -0.7, yaw])
    for found, expected in zip(under_one(one, centre, root, 0.03), by_summing(one, centre, root, 0.03), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize(("bins", "first_bin"), [(BINS, 0), (50, 3), (20, 55)])
@pytest.mark.parametrize("sigmas", [(0.3, 0.3, 0.03), (0.3, 0.3, 1.0), (1.2, 1.1, 0.3), (1.2, 1.1, 1.5)])
def test_turning_the_scene_changes_nothing(bins, first_bin, sigmas):
    """By whole bins, so that the cells are the same; narrow windows and wide ones."""
    root = np.diag(sigmas) @ TILT
    expected = under_one(patch(bins, first_bin), (22.6, -0.7, 0.02), root, 0.0)
    for turn in range(1, BINS, 3):
        turned = patch(bins, (first_bin + turn) % BINS)
        if bins == BINS:  # the same cells, written down from bin 0 on
            turned = LikelihoodPatch(np.roll(patch(bins, 0).log_prob, turn, axis=2), GRID, 0, BINS, FLOOR, UNIFORM)
        centre = (22.6, -0.7, 0.02 + turn * BIN)
        for found, same in zip(under_one(turned, centre, root, 0.0), expected, strict=True):
            np.testing.assert_allclose(found, same, rtol=0.0, atol=2e-5)


@pytest.mark.parametrize("yaw", YAWS)
@pytest.mark.parametrize("bins", [BINS, 50, 20])
@pytest.mark.parametrize("heading", [0.3, 2.0])
def test_headings_of_a_window_narrow_across_see_every_image(bins, yaw, heading):
    """A lattice of positions, where the likelihood is flat in x and y: a sum along the heading alone, finely."""
    along = np.pi * (np.arange(bins) + 0.5) / bins
    cells = FLOOR + 3.0 * np.sin(along) ** 2 * (1.0 + 0.5 * np.sin(2.0 * along))  # down to the floor at its ends
    one = LikelihoodPatch(np.tile(cells, (GRID.rows, GRID.cols, 1)), GRID, 9, BINS, FLOOR, UNIFORM)
    log_mass, mean, spread = under_one(one, (22.6, -0.7, yaw), np.diag([0.2, 0.2, heading]), 0.0)
    u = np.linspace(-REACH, REACH, 40_001)
    place = (yaw + heading * u) / BIN - 9.0
    place -= BINS * np.floor((place + 0.5) / BINS)  # from -1/2 on
    middle = np.floor(place + 0.5).astype(int)
    t = place - middle
    around = middle[:, None] + [-1, 0, 1]
    around = around % bins if bins == BINS else np.clip(around, 0, bins - 1)
    spline = np.stack([0.5 * (0.5 - t) ** 2, 0.75 - t * t, 0.5 * (0.5 + t) ** 2], axis=-1)
    values = np.einsum("nk,nk->n", spline, cells.astype(np.float32)[around])
    weight = np.exp(np.where(middle < bins, values, FLOOR) - 0.5 * u * u)
    expected = weight @ u / weight.sum()
    np.testing.assert_allclose(log_mass, np.log(weight.sum() / np.exp(-0.5 * u * u).sum()), atol=2e-3)
    np.testing.assert_allclose(mean[2], expected, atol=2e-3)
    np.testing.assert_allclose(spread[2, 2], weight @ u**2 / weight.sum() - expected**2, atol=2e-3)


@pytest.mark.parametrize("outlier", [0.0, 0.05])
@pytest.mark.parametrize("floor", [FLOOR, -5000.0])
@pytest.mark.parametrize("centre", [(500.0, 0.0, 1.5), (22.6, 300.0, 0.0), (22.6, -0.7, 1.5)])
def test_beyond_the_cells_a_window_says_nothing_whatever_its_width(centre, floor, outlier):
    """Off the crop, or at a heading that was not evaluated: the floor, and the window as it is."""
    one = LikelihoodPatch(np.zeros((GRID.rows, GRID.cols, 5)), GRID, 45, BINS, floor, UNIFORM)
    least = max(floor, UNIFORM - 87.0)
    expected = np.log((1.0 - outlier) * np.exp(least - UNIFORM) + outlier) + UNIFORM
    for sigma in (0.2, 2.0):
        log_mass, mean, spread = under_one(one, centre, np.diag([sigma, sigma, 0.16 * sigma + 0.01]), outlier)
        assert log_mass == pytest.approx(expected, abs=1e-5)
        np.testing.assert_allclose(mean, 0.0, atol=1e-5)
        np.testing.assert_allclose(spread, np.eye(3), atol=5e-3)


def two_nodes(yaw, at, off, outlier):
    """A smoother's answer where a node or two saw a Gaussian at a place, and the start is off it."""
    grid, bins = MapGrid(40, 40, 0.5, -10.0, -10.0), 72
    x, y = grid.centres()
    turned = (np.arange(bins) * 2.0 * np.pi / bins - yaw + np.pi) % (2.0 * np.pi) - np.pi
    plan = (x[None, :, None] ** 2 + y[:, None, None] ** 2) / 4.0
    seen = LikelihoodVolume.from_scores((-0.5 * (plan + (turned / 0.3) ** 2)).astype(np.float32), grid)
    start = np.array([at + off, 0.0, yaw])
    increment = OdometryIncrement(10**9, np.zeros(3), np.diag([0.01, 0.01, 1e-4]))
    spread = np.repeat(np.diag([9.0, 9.0, 0.12])[None], 2, axis=0)
    initial = Trajectory(np.array([0, 10**9]), np.array([start, start]), spread)
    prior = UniformPrior(np.array([at, 0.0, yaw]), 5.0, 0.6)
    return smooth([0, 10**9], [increment], [seen, None], prior, initial, SmootherSettings(outlier_probability=outlier))


def test_a_drive_is_smoothed_alike_at_every_heading():
    expected = two_nodes(1.5, 0.0, 0.0, 0.0)
    for yaw in (0.0, 0.05, 3.1, np.pi, -0.2, -1.5):
        found = two_nodes(yaw, 0.0, 0.0, 0.0)
        off = found.trajectory.poses - expected.trajectory.poses - [0.0, 0.0, yaw - 1.5]
        off[:, 2] = (off[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
        np.testing.assert_allclose(off, 0.0, atol=1e-4)
        np.testing.assert_allclose(found.trajectory.covariances, expected.trajectory.covariances, atol=1e-4)


@pytest.mark.parametrize("outlier", [0.0, 0.05])
def test_a_start_far_off_the_cells_is_smoothed(outlier):
    found = two_nodes(1.5, 40.0, 3.0, outlier)
    assert np.isfinite(found.trajectory.covariances).all()
    np.testing.assert_allclose(found.trajectory.poses, [[40.0, 0.0, 1.5]] * 2, atol=1e-3)


def test_a_kept_volume_sees_both_sides_of_its_first_bin():
    """Closed form: a heading's Gaussian of 0.3 rad under a window of 0.25, at yaw 0."""
    turned = (np.arange(BINS) * BIN + np.pi) % (2.0 * np.pi) - np.pi
    scores = np.broadcast_to(-0.5 * (turned / 0.3) ** 2, (40, 40, BINS)).astype(np.float32)
    one = patch_of(LikelihoodVolume.from_scores(scores, MapGrid(40, 40, 0.5, -10.0, -10.0)))
    log_mass, mean, spread = under_one(one, (0.0, 0.0, 0.0), np.diag([1.0, 1.0, 0.25]), 0.0)
    assert mean[2] == pytest.approx(0.0, abs=1e-6)
    assert spread[2, 2] == pytest.approx(0.09 / (0.09 + 0.0625), abs=1e-3)
    assert log_mass == pytest.approx(-0.5 * np.log(2.0 * np.pi * 0.1525) - np.log(400.0), abs=1e-3)
