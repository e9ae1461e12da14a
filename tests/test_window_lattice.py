"""Likelihoods under narrow windows: the vector code gives what the definition gives in 64-bit numpy, edges and all."""

import numpy as np
import pytest

from fusion import MapGrid
from fusion.graph.likelihood_bank import LikelihoodBank
from fusion.graph.patch import LikelihoodPatch
from fusion.graph.window_lattice import REACH

OUTLIER, FLOOR, UNIFORM = 0.03, -14.0, -9.0
GRID = MapGrid(9, 11, 0.5, 20.0, -3.0)


def patch(seed, bins, bin_count, first_bin):
    """Cells without any smoothness."""
    values = np.random.default_rng(seed).uniform(-12.0, 2.0, (GRID.rows, GRID.cols, bins)).astype(np.float32)
    return LikelihoodPatch(values, GRID, first_bin, bin_count, FLOOR, UNIFORM)


def spline_weights(position):
    """Cells (..., 3) that a position reaches, and their weights."""
    middle = np.floor(position + 0.5)
    t = position - middle
    weights = np.stack([0.5 * (0.5 - t) ** 2, 0.75 - t * t, 0.5 * (0.5 + t) ** 2], axis=-1)
    return middle[..., None].astype(int) + [-1, 0, 1], weights


def at_poses(one, poses):
    """The mixture's density (...,) at poses (..., 3): a quadratic B-spline of log densities, and the floor outside."""
    rows, cols, bins = one.log_prob.shape
    x, y, yaw = one.first_centre
    cell = 2.0 * np.pi / one.bin_count
    col, row = (poses[..., 0] - x) / GRID.metres_per_pixel, (y - poses[..., 1]) / GRID.metres_per_pixel
    middle = 0.5 * cell * (bins - 1)
    heading = (((poses[..., 2] - yaw - middle + np.pi) % (2.0 * np.pi)) - np.pi + middle) / cell
    inside = (row >= -0.5) & (row < rows - 0.5) & (col >= -0.5) & (col < cols - 0.5)
    if not one.wraps:
        inside &= (heading >= -0.5) & (heading < bins - 0.5)
    (r, by_row), (c, by_col), (b, by_bin) = (spline_weights(place) for place in (row, col, heading))
    r, c = np.clip(r, 0, rows - 1), np.clip(c, 0, cols - 1)
    b = b % bins if one.wraps else np.clip(b, 0, bins - 1)
    around = one.log_prob[r[..., :, None, None], c[..., None, :, None], b[..., None, None, :]].astype(np.float64)
    values = np.einsum("...ijk,...i,...j,...k->...", around, by_row, by_col, by_bin)
    return (1.0 - OUTLIER) * np.exp(np.where(inside, values, FLOOR)) + OUTLIER * np.exp(UNIFORM)


def by_definition(one, centre, root):
    """ln mass, mean, covariance, variances of a flat likelihood."""
    lengths = np.abs(root / np.array([[0.5], [0.5], [2.0 * np.pi / one.bin_count]])).max(axis=0)
    counts = np.ceil(REACH / np.minimum(1.05, 0.8 / lengths)).astype(int)
    axes = [np.linspace(-REACH, REACH, 2 * count + 1) for count in counts]
    u = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    u = u[(u[..., 0] ** 2 + u[..., 1] ** 2 <= REACH**2)]
    window = np.exp(-0.5 * (u**2).sum(axis=-1))
    weight = window * at_poses(one, centre + u @ root.T)
    mean = weight @ u / weight.sum()
    spread = np.einsum("n,ni,nj->ij", weight, u, u) / weight.sum() - np.outer(mean, mean)
    return np.log(weight.sum() / window.sum()), mean, spread, window @ u**2 / window.sum()


@pytest.mark.parametrize(
    ("bins", "bin_count", "first_bin", "centre"),
    [
        (25, 180, 20, (22.6, -0.7, 1.1)),  # in the middle
        (25, 180, 20, (22.6, -0.7, 0.75)),  # across the first bin
        (25, 180, 20, (22.6, -0.7, 1.5 + 4.0 * np.pi)),  # across the last, turns apart
        (25, 180, 20, (20.1, 1.2, 1.1)),  # across a corner
        (25, 180, 20, (25.4, -2.9, 1.4)),  # where the table ends
        (25, 180, 20, (60.0, 0.0, 1.1)),  # beyond
        (25, 180, 170, (22.6, -0.7, 0.1)),  # bins across the seam
        (90, 90, 0, (22.6, -0.7, 0.02)),  # a whole circle, at its seam
        (90, 90, 0, (22.6, -0.7, -2.0)),
        (1, 180, 20, (22.6, -0.7, 0.7)),  # a single bin
    ],
)
@pytest.mark.parametrize("sigmas", [(0.2, 0.3, 0.01), (0.6, 0.4, 0.1), (0.5, 0.01, 1e-5), (1e-4, 2.0, 0.03)])
def test_moments_are_those_of_the_definition(bins, bin_count, first_bin, centre, sigmas):
    one = patch(bins, bins, bin_count, first_bin)
    tilt = np.array([[1.0, 0.0, 0.0], [0.4, 0.9, 0.0], [-0.3, 0.2, 0.9]])
    root = np.diag(sigmas) @ tilt
    bank = LikelihoodBank([patch(1, 7, 180, 3), one], OUTLIER)
    centres = np.array([[0.0, 0.0, 0.0], centre])
    found = bank.windowed(centres, np.stack([np.eye(3), root @ root.T]))
    log_mass, mean, spread, flat = by_definition(one, centres[1], root)
    np.testing.assert_allclose(found.log_mass[1], log_mass, atol=2e-5)
    np.testing.assert_allclose(found.means[1], mean, atol=5e-5)
    np.testing.assert_allclose(found.spreads[1], spread, atol=1e-4)
    np.testing.assert_allclose(found.flat[1], flat, atol=1e-9)


def test_the_same_windows_give_the_same_bits_and_leave_the_cells_alone():
    patches = [patch(seed, 25, 180, 20) for seed in range(5)]
    before = [one.log_prob.copy() for one in patches]
    centres, windows = np.tile([22.6, -0.7, 1.1], (5, 1)), np.tile(np.diag([0.2, 0.3, 0.02]) ** 2, (5, 1, 1))
    first, second = (LikelihoodBank(patches, OUTLIER).windowed(centres, windows) for _ in range(2))
    for name in ("log_mass", "means", "spreads", "flat"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    for one, cells in zip(patches, before, strict=True):
        np.testing.assert_array_equal(one.log_prob, cells)
