"""The two-level likelihood against the same density on fine cells alone, and against closed forms."""

import numpy as np
import pytest

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume
from fusion.two_level import TwoLevelLikelihood

GRID = MapGrid(6, 5, 3.0, 10.0, -20.0)
BINS, SIDE, TURN = 8, 3, 5


def fine_scores(seed: int = 0) -> np.ndarray:
    """Log densities (rows, cols, bins) on fine cells, rough."""
    return np.random.default_rng(seed).normal(0.0, 2.0, (GRID.rows * SIDE, GRID.cols * SIDE, BINS * TURN))


def blocks_of(fine: np.ndarray) -> np.ndarray:
    """(rows, cols, K, SIDE, SIDE, TURN): the fine cells of every coarse one."""
    rolled = np.roll(fine, TURN // 2, axis=2)
    return rolled.reshape(GRID.rows, SIDE, GRID.cols, SIDE, BINS, TURN).transpose(0, 2, 4, 1, 3, 5)


def two_level(cells: np.ndarray, seed: int = 0) -> tuple[TwoLevelLikelihood, LikelihoodVolume]:
    """Cut at `cells` (M, 3), and the same density on fine cells alone."""
    blocks = blocks_of(fine_scores(seed))
    coarse = np.log(np.exp(blocks).mean(axis=(3, 4, 5)))
    found = TwoLevelLikelihood.from_scores(coarse, GRID, cells, blocks[tuple(cells.T)])
    flat = np.broadcast_to(coarse[..., None, None, None], blocks.shape).copy()
    flat[tuple(cells.T)] = blocks[tuple(cells.T)]
    whole = flat.transpose(0, 3, 1, 4, 2, 5).reshape(GRID.rows * SIDE, GRID.cols * SIDE, BINS * TURN)
    grid = MapGrid(GRID.rows * SIDE, GRID.cols * SIDE, 1.0, GRID.x0, GRID.y0)
    return found, LikelihoodVolume.from_scores(np.roll(whole, -(TURN // 2), axis=2), grid)


SOME = np.array([[0, 0, 0], [0, 1, 0], [3, 2, 7], [3, 2, 0], [5, 4, 3]])
ALL = np.argwhere(np.ones((GRID.rows, GRID.cols, BINS), bool))


def anywhere(n: int, seed: int = 1) -> np.ndarray:
    low, high = [GRID.x0 - 2.0, GRID.y0 - 2.0, -7.0], [GRID.x0 + 17.0, GRID.y0 + 20.0, 7.0]
    return np.random.default_rng(seed).uniform(low, high, (n, 3))


@pytest.mark.parametrize("cells", [SOME, ALL, SOME[:0]], ids=["some", "all", "none"])
def test_it_is_the_density_on_fine_cells(cells: np.ndarray) -> None:
    found, whole = two_level(cells)
    poses = anywhere(5000)
    inside = GRID.contains(poses[:, :2])
    np.testing.assert_allclose(found.log_density(poses)[inside], whole.log_density(poses)[inside], atol=2e-5)
    np.testing.assert_allclose(found.draw_log_density(poses)[inside], whole.draw_log_density(poses)[inside], atol=2e-5)
    assert (found.log_density(poses)[~inside] == found.floor).all()
    assert found.searched_volume == pytest.approx(GRID.area_m2 * 2 * np.pi)


@pytest.mark.parametrize("cells", [SOME, ALL, SOME[:0]], ids=["some", "all", "none"])
def test_tempering_keeps_it_the_same_as_on_fine_cells(cells: np.ndarray) -> None:
    found, whole = two_level(cells)
    poses = anywhere(2000)
    poses = poses[GRID.contains(poses[:, :2])]
    np.testing.assert_allclose(
        found.tempered(2.5).log_density(poses), whole.tempered(2.5).log_density(poses), atol=2e-5
    )


@pytest.mark.parametrize("cells", [SOME, SOME[:0]], ids=["some", "none"])
def test_draws_follow_the_density(cells: np.ndarray) -> None:
    found, whole = two_level(cells)
    drawn = found.sample(200_000, np.random.default_rng(2))
    assert GRID.contains(drawn[:, :2]).all()
    fine = whole.grid.pixel_from_xy(drawn[:, :2]).astype(int)
    bins = np.rint(drawn[:, 2] * BINS * TURN / (2 * np.pi)).astype(int) % (BINS * TURN)
    counts = np.zeros(whole.log_prob.shape)
    np.add.at(counts, (fine[:, 0], fine[:, 1], bins), 1.0)
    expected = np.exp(whole.log_prob.astype(float)) * whole.cell_volume * len(drawn)
    # chi2 over cells of some weight: mean 1 a cell, standard deviation sqrt(2 / cells).
    well = expected > 20.0
    statistic = ((counts - expected) ** 2 / expected)[well].mean()
    assert abs(statistic - 1.0) < 5.0 * np.sqrt(2.0 / well.sum())


def gaussian(mean: np.ndarray, sigma: np.ndarray) -> TwoLevelLikelihood:
    """A Gaussian, cut wherever it has mass."""
    grid = MapGrid(GRID.rows * SIDE, GRID.cols * SIDE, 1.0, GRID.x0, GRID.y0)
    x, y = grid.centres()
    yaw = np.arange(BINS * TURN) * 2 * np.pi / (BINS * TURN)
    away = (yaw - mean[2] + np.pi) % (2 * np.pi) - np.pi
    scores = -0.5 * (
        ((x[None, :, None] - mean[0]) / sigma[0]) ** 2
        + ((y[:, None, None] - mean[1]) / sigma[1]) ** 2
        + (away / sigma[2]) ** 2
    )
    blocks = blocks_of(scores)
    coarse = np.log(np.exp(blocks).mean(axis=(3, 4, 5)))
    cells = np.argwhere(coarse > -25.0)
    return TwoLevelLikelihood.from_scores(np.maximum(coarse, -60.0), GRID, cells, blocks[tuple(cells.T)])


def test_the_mode_of_a_gaussian_has_its_moments() -> None:
    mean, sigma = np.array([16.3, -11.2, -0.05]), np.array([1.1, 0.9, 0.12])
    mixture = gaussian(mean, sigma).modes(3)
    assert mixture.weights[0] > 0.98
    np.testing.assert_allclose(mixture.means[0], mean, atol=0.02)
    # The spread inside a cell of 1 m and 9 degrees is on top.
    expected = sigma**2 + np.array([1.0, 1.0, np.deg2rad(9.0) ** 2]) / 12.0
    np.testing.assert_allclose(np.diag(mixture.covariances[0]), expected, rtol=0.08)


def test_around_is_the_density_given_a_window() -> None:
    found, whole = two_level(SOME)
    centre = np.array([17.0, -11.0, 0.0])
    part = found.around(centre, 3.0)
    x, y = part.grid.centres()
    poses = np.array([[x[1], y[2], 0.4], [x[3], y[0], -2.0], [x[0], y[0], 3.0]])
    difference = part.log_density(poses) - whole.log_density(poses)
    np.testing.assert_allclose(difference, difference[0], atol=3e-5)
    assert np.exp(part.log_prob.astype(float)).sum() * part.cell_volume == pytest.approx(1.0, abs=1e-4)


def test_nonsense_is_named() -> None:
    found, _ = two_level(SOME)
    with pytest.raises(SkyfixError, match=r"cut cells: expected each at most once"):
        TwoLevelLikelihood(found.coarse, GRID, np.concatenate([SOME[:-1], SOME[:1]]), found.fine)
    with pytest.raises(SkyfixError, match=r"coarse likelihood: expected \(6, 5, K\)"):
        TwoLevelLikelihood(found.coarse[:-1], GRID, SOME, found.fine)
    with pytest.raises(SkyfixError, match="n and k odd"):
        TwoLevelLikelihood(found.coarse, GRID, SOME, found.fine[..., :-1])
    with pytest.raises(SkyfixError, match="integrates to 1"):
        TwoLevelLikelihood(found.coarse + 1.0, GRID, SOME, found.fine + 1.0)
    with pytest.raises(SkyfixError, match="finite"):
        TwoLevelLikelihood.from_scores(np.full_like(found.coarse, np.nan), GRID, SOME, found.fine)
