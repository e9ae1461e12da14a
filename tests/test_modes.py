"""Modes: the Gaussians that a likelihood was made of come out again."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion import GaussianMixture, LikelihoodVolume, MapGrid, SkyfixError, find_modes, se2
from fusion.modes import circular_run

GRID = MapGrid(rows=65, cols=65, metres_per_pixel=0.5, x0=-16.25, y0=-16.25)
BINS = 180


def volume_of(mixture, grid=GRID, bins=BINS, valid=None, background=0.0):
    x, y = grid.centres()
    yaw = se2.wrap(np.arange(bins) * 2 * np.pi / bins)
    used = np.arange(bins) if valid is None else np.flatnonzero(valid)
    poses = np.stack(np.broadcast_arrays(x[None, :, None], y[:, None, None], yaw[used]), axis=-1)
    density = np.exp(mixture.log_density(poses.reshape(-1, 3))).reshape(poses.shape[:3])
    scores = np.zeros((grid.rows, grid.cols, bins))
    scores[:, :, used] = np.log(density + background + 1e-300)
    return LikelihoodVolume.from_scores(scores, grid, valid=valid)


def mixture(*components):
    weights, means, covariances = zip(*components, strict=True)
    return GaussianMixture(np.array(weights), np.array(means, dtype=float), np.array(covariances, dtype=float))


def diagonal(x, y, yaw):
    return np.diag([x**2, y**2, yaw**2])


NEAR_NORTH = np.abs(se2.wrap(np.arange(BINS) * 2 * np.pi / BINS - np.pi / 2)) < np.deg2rad(40.0)


@pytest.mark.parametrize("sigma", [0.4, 1.0, 3.0])
@pytest.mark.parametrize("valid", [NEAR_NORTH, None])
def test_one_gaussian_comes_out_as_it_went_in(sigma, valid):
    coupled = np.array([[sigma**2, 0.5 * sigma**2, 0.0], [0.5 * sigma**2, sigma**2, 0.0], [0.0, 0.0, 0.06**2]])
    coupled[0, 2] = coupled[2, 0] = 0.3 * sigma * 0.06
    wanted = mixture((1.0, [2.1, -3.2, np.pi / 2], coupled))
    found = find_modes(volume_of(wanted, valid=valid), 3)
    best = np.argmax(found.weights)
    assert found.weights[best] > 0.97
    np.testing.assert_allclose(found.means[best], wanted.means[0], atol=0.02)
    cell = np.diag([0.5**2, 0.5**2, (2 * np.pi / BINS) ** 2]) / 12
    scale = np.sqrt(np.outer(np.diag(coupled), np.diag(coupled)))
    assert (np.abs(found.covariances[best] - coupled - cell) < 0.06 * scale).all()


def test_two_gaussians_are_told_apart_with_their_weights():
    wanted = mixture(
        (0.65, [5.0, 6.0, 1.6], diagonal(0.8, 0.5, 0.03)), (0.35, [-7.0, 2.0, 1.4], diagonal(0.6, 0.9, 0.05))
    )
    found = find_modes(volume_of(wanted, valid=NEAR_NORTH), 5)
    np.testing.assert_allclose(found.weights[:2], [0.65, 0.35], atol=0.02)
    np.testing.assert_allclose(found.means[:2], wanted.means, atol=0.02)
    np.testing.assert_allclose(
        np.sqrt(np.diagonal(found.covariances[:2], axis1=1, axis2=2)),
        np.sqrt(np.diagonal(wanted.covariances, axis1=1, axis2=2)),
        rtol=0.08,
    )


def test_same_place_opposite_headings_are_two_modes():
    wanted = mixture(
        (0.6, [0.0, 0.0, 0.0], diagonal(0.7, 0.7, 0.05)), (0.4, [0.0, 0.0, np.pi], diagonal(0.7, 0.7, 0.05))
    )
    found = find_modes(volume_of(wanted), 4)
    np.testing.assert_allclose(found.weights[:2], [0.6, 0.4], atol=0.01)
    np.testing.assert_allclose(np.abs(found.means[:2, 2]), [0.0, np.pi], atol=0.01)


@pytest.mark.parametrize("yaw", [0.0, np.pi - 0.01, -np.pi + 0.01, -0.004])
@pytest.mark.parametrize("masked", [False, True])
def test_the_seam_of_the_circle_does_not_show(yaw, masked):
    valid = np.abs(se2.wrap(np.arange(BINS) * 2 * np.pi / BINS - yaw)) < 0.4 if masked else None
    wanted = mixture((1.0, [1.0, 1.0, yaw], diagonal(0.8, 0.8, 0.08)))
    found = find_modes(volume_of(wanted, valid=valid), 2)
    assert abs(se2.wrap(found.means[0, 2] - yaw)) < 0.003
    assert np.sqrt(found.covariances[0, 2, 2]) == pytest.approx(0.08, rel=0.05)


def test_clutter_stays_out_of_the_moments():
    wanted = mixture((1.0, [3.0, 3.0, 1.5], diagonal(0.6, 0.6, 0.04)))
    clutter = 0.3 / 0.7 / (GRID.area_m2 * np.deg2rad(79.0))
    found = find_modes(volume_of(wanted, valid=NEAR_NORTH, background=clutter), 1)
    assert found.weights[0] == pytest.approx(0.7, abs=0.03)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariances[0])), [0.6, 0.6, 0.04], rtol=0.1)


def test_a_peak_in_one_cell_gets_the_spread_of_a_cell():
    scores = np.full((65, 65, BINS), -30.0)
    scores[40, 50, BINS // 4] = 0.0
    found = find_modes(LikelihoodVolume.from_scores(scores, GRID), 1)
    width = np.array([0.5, 0.5, 2 * np.pi / BINS])
    np.testing.assert_allclose(found.covariances[0], np.diag(width**2 / 12), rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(found.means[0], [*GRID.xy_from_pixel((40.5, 50.5)), np.pi / 2], atol=1e-3)


def test_peaks_at_the_corner_and_in_a_flat_volume_are_found():
    corner = mixture((1.0, [-16.0, 16.0, 1.5], diagonal(1.0, 1.0, 0.05)))
    found = find_modes(volume_of(corner, valid=NEAR_NORTH), 1)
    assert GRID.contains(found.means[0, :2])
    small = MapGrid(5, 4, 0.5, 0.0, 0.0)
    flat = find_modes(LikelihoodVolume.from_scores(np.zeros((5, 4, 8)), small), 1)
    np.testing.assert_allclose(flat.means[0, :2], small.centre_xy, atol=1e-6)
    np.testing.assert_allclose(np.diag(flat.covariances[0])[:2], [2.0**2 / 12, 2.5**2 / 12], rtol=1e-5)


@given(st.integers(0, 10_000), st.integers(1, 8), st.floats(0.5, 15.0))
@settings(max_examples=30, deadline=None)
def test_modes_of_noise_are_sound(seed, k, temperature):
    rng = np.random.default_rng(seed)
    grid = MapGrid(int(rng.integers(1, 20)), int(rng.integers(1, 20)), 0.5, 0.0, 0.0)
    bins = int(rng.integers(1, 20))
    scores = rng.normal(0.0, 5.0, (grid.rows, grid.cols, bins))
    valid = rng.random(bins) < 0.5
    valid[int(rng.integers(bins))] = True
    found = find_modes(LikelihoodVolume.from_scores(scores, grid, valid=valid).tempered(temperature), k)
    assert 1 <= len(found) <= k
    assert (np.diff(found.weights) <= 0).all()
    assert found.weights.sum() <= 1.0 + 1e-6
    assert np.linalg.eigvalsh(found.covariances).min() > 0.0
    assert grid.contains(found.means[:, :2]).all()


def test_modes_turn_with_the_map():
    """A quarter turn of the raster turns the means and the covariances, and nothing else."""
    wanted = mixture(
        (0.7, [5.0, 2.0, 0.3], diagonal(1.2, 0.5, 0.05)), (0.3, [-6.0, 8.0, -0.2], diagonal(0.5, 0.7, 0.04))
    )
    volume = volume_of(wanted)
    turned = LikelihoodVolume(np.roll(np.rot90(volume.log_prob), BINS // 4, axis=2), GRID, volume.floor)
    a, b = find_modes(volume, 2), find_modes(turned, 2)
    np.testing.assert_allclose(b.means, se2.compose(np.array([0.0, 0.0, np.pi / 2]), a.means), atol=1e-4)
    rotation = se2.rotation(np.pi / 2)
    np.testing.assert_allclose(b.covariances, rotation @ a.covariances @ rotation.T, atol=1e-4)


def test_a_masked_volume_is_fast():
    wanted = mixture(
        (0.7, [5.0, 6.0, 1.6], diagonal(0.8, 0.5, 0.03)), (0.3, [-7.0, 2.0, 1.4], diagonal(0.6, 0.9, 0.05))
    )
    valid = np.abs(se2.wrap(np.arange(BINS) * 2 * np.pi / BINS - np.pi / 2)) < np.deg2rad(12.4)
    volume = volume_of(wanted, valid=valid, background=1e-6)
    seconds = []
    for _ in range(10):
        start = time.perf_counter()
        find_modes(volume, 5)
        seconds.append(time.perf_counter() - start)
    assert min(seconds) < 0.05  # a few milliseconds when nothing else runs


def test_mixture_density_is_that_of_scipy_and_wraps():
    from scipy.stats import multivariate_normal

    one = mixture((0.4, [1.0, 2.0, 3.1], diagonal(1.0, 2.0, 0.1)), (0.5, [0.0, 0.0, 0.0], diagonal(0.5, 0.5, 0.2)))
    at = np.array([[0.5, 1.0, -3.1], [0.0, 0.1, 0.2]])
    unwrapped = np.array([[0.5, 1.0, 2 * np.pi - 3.1], [0.0, 0.1, 0.2]])
    expected = 0.4 * multivariate_normal(one.means[0], one.covariances[0]).pdf(unwrapped)
    expected += 0.5 * multivariate_normal(one.means[1], one.covariances[1]).pdf(at)
    np.testing.assert_allclose(np.exp(one.log_density(at)), expected, rtol=1e-9)


def test_bad_mixtures_are_refused():
    good = np.eye(3)[None]
    for weights, means, covariances in (
        ([], np.zeros((0, 3)), np.zeros((0, 3, 3))),
        ([0.0], np.zeros((1, 3)), good),
        ([1.2], np.zeros((1, 3)), good),
        ([1.0], np.full((1, 3), np.nan), good),
        ([1.0], np.zeros((1, 3)), np.zeros((1, 3, 3))),
    ):
        with pytest.raises(SkyfixError, match="mixture"):
            GaussianMixture(np.array(weights), means, covariances)
    with pytest.raises(SkyfixError, match="modes"):
        find_modes(LikelihoodVolume.from_scores(np.zeros((5, 4, 8)), MapGrid(5, 4, 0.5, 0.0, 0.0)), 0)


@given(st.lists(st.booleans(), min_size=1, max_size=40).filter(any))
def test_circular_run_is_the_shortest_arc_over_all_hits(mask):
    mask = np.array(mask)
    run = circular_run(mask)
    assert mask[run].sum() == mask.sum()
    assert (np.diff(run) % len(mask) == 1).all() or len(run) == 1
    hits = np.flatnonzero(mask)
    shortest = min(int(((hits - start) % len(mask)).max()) + 1 for start in hits)
    assert len(run) == shortest


def test_a_tempered_gaussian_is_its_power() -> None:
    """One component: N^(1/T) normalised is N with T times the covariance, and tempering twice multiplies."""
    rng = np.random.default_rng(5)
    root = rng.normal(size=(3, 3)) * [0.8, 0.5, 0.05]
    single = GaussianMixture(np.array([0.9]), rng.normal(size=(1, 3)), (root.T @ root + 1e-4 * np.eye(3))[None])
    poses = single.means[0] + 0.05 * rng.normal(size=(50, 3))
    power = single.log_density(poses) / 4.0
    flat = single.tempered(4.0)
    np.testing.assert_allclose(np.diff(flat.log_density(poses)), np.diff(power), atol=1e-9)
    np.testing.assert_allclose(flat.weights, 0.9)
    np.testing.assert_allclose(single.tempered(2.0).tempered(2.0).covariances, flat.covariances)


def test_tempering_brings_separate_components_closer_by_the_power() -> None:
    """Far apart, the density at each peak is that of the mixture to the power 1/T, up to one factor for all."""
    means = np.array([[0.0, 0.0, 0.0], [500.0, 0.0, 1.0], [0.0, 500.0, -2.0]])
    covariances = np.array([np.diag([s, 2 * s, 0.01]) for s in (0.5, 1.0, 3.0)])
    mixture = GaussianMixture(np.array([0.1, 0.6, 0.2]), means, covariances)
    flat = mixture.tempered(3.0)
    assert flat.weights.sum() == pytest.approx(0.9)
    assert (np.diff(flat.weights) <= 0).all()
    np.testing.assert_allclose(np.diff(flat.log_density(means)), np.diff(mixture.log_density(means)) / 3.0, atol=1e-9)
    with pytest.raises(SkyfixError, match="temperature"):
        mixture.tempered(0.0)


def test_covariances_that_are_not_symmetric_are_refused():
    lopsided = np.array([[1.0, 0.9, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    for covariance in (lopsided, lopsided.T):
        with pytest.raises(SkyfixError, match="expected symmetric matrices"):
            GaussianMixture(np.ones(1), np.zeros((1, 3)), covariance[None])


def test_a_mixture_keeps_what_it_was_given():
    weights, covariance = np.ones(1), np.eye(3)[None]
    made = GaussianMixture(weights, np.zeros((1, 3)), covariance)
    weights *= 0.5
    covariance *= 100.0
    assert made.weights[0] == 1.0
    np.testing.assert_array_equal(made.covariances[0], np.eye(3))
