"""Likelihoods: densities that integrate to one, whatever is done to them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from fusion import GaussianLikelihood, LikelihoodVolume, LocationOrientationMaps, MapGrid, SkyfixError, se2
from fusion.likelihood import log_uniform_density

GRID = MapGrid(rows=9, cols=7, metres_per_pixel=0.5, x0=100.0, y0=-20.0)
BINS = 12


def random_scores(seed, bins=BINS, scale=2.0):
    return np.random.default_rng(seed).normal(0.0, scale, (GRID.rows, GRID.cols, bins)).astype(np.float32)


def centres(bins=BINS):
    """Poses (rows * cols * K, 3) of the cell centres, in the order of the array."""
    x, y = GRID.centres()
    yaw = se2.wrap(np.arange(bins) * 2 * np.pi / bins)
    return np.stack(np.broadcast_arrays(x[None, :, None], y[:, None, None], yaw), axis=-1).reshape(-1, 3)


def cell_volume(bins=BINS):
    return GRID.metres_per_pixel**2 * 2 * np.pi / bins


def quadrature(likelihood, bins=BINS):
    """Integral over the crop by the mid-point rule on the cells."""
    return np.exp(likelihood.log_density(centres(bins))).sum() * cell_volume(bins)


@given(st.integers(0, 1000), st.floats(0.2, 20.0), st.floats(0.0, 0.9))
@settings(max_examples=40, deadline=None)
def test_everything_integrates_to_one(seed, temperature, outliers):
    valid = np.random.default_rng(seed).random((GRID.rows, GRID.cols, BINS)) < 0.7
    volume = LikelihoodVolume.from_scores(random_scores(seed), GRID, valid=valid)
    assert quadrature(volume) == pytest.approx(1.0, abs=1e-5)
    assert quadrature(volume.tempered(temperature)) == pytest.approx(1.0, abs=1e-5)
    assert quadrature(volume.with_outliers(outliers)) == pytest.approx(1.0, abs=1e-5)
    assert quadrature(volume.tempered(temperature).with_outliers(outliers)) == pytest.approx(1.0, abs=1e-5)


def test_from_scores_is_a_softmax_over_the_valid_cells():
    scores, temperature = random_scores(0).astype(np.float64), 1.7
    yaw_valid = np.arange(BINS) % 3 == 0
    volume = LikelihoodVolume.from_scores(scores, GRID, temperature, yaw_valid)
    weight = np.exp(scores / temperature) * yaw_valid
    expected = weight / weight.sum() / cell_volume()
    got = np.exp(volume.log_prob.astype(np.float64))
    np.testing.assert_allclose(got[..., yaw_valid], expected[..., yaw_valid], rtol=1e-5)
    assert (volume.log_prob[..., ~yaw_valid] == volume.floor).all()


@pytest.mark.parametrize("shape", [(BINS,), (GRID.rows, GRID.cols, 1), (GRID.rows, GRID.cols, BINS)])
def test_masks_broadcast_and_hide_nan(shape):
    valid = np.random.default_rng(1).random(shape) < 0.5
    scores = random_scores(1)
    full = np.broadcast_to(valid, scores.shape)
    scores[~full] = np.nan
    volume = LikelihoodVolume.from_scores(scores, GRID, valid=valid)
    assert ((volume.log_prob > volume.floor) == full).all()
    assert quadrature(volume) == pytest.approx(1.0, abs=1e-5)


def test_floor_lies_below_every_valid_cell_however_sharp_the_scores():
    scores = random_scores(2, scale=500.0)
    volume = LikelihoodVolume.from_scores(scores, GRID)
    assert (volume.log_prob > volume.floor).all()
    flattened = volume.tempered(1000.0)  # nothing of the scores was lost to the floor
    expected = LikelihoodVolume.from_scores(scores, GRID, temperature=1000.0)
    np.testing.assert_allclose(flattened.log_prob, expected.log_prob, atol=1e-3)


def test_cell_centres_get_their_cell_s_value():
    volume = LikelihoodVolume.from_scores(random_scores(3), GRID)
    np.testing.assert_allclose(volume.log_density(centres()), volume.log_prob.reshape(-1), atol=1e-4)


def test_interpolation_reproduces_a_linear_function_and_clamps_beyond_the_outer_centres():
    x, y = GRID.centres()
    plane = 0.3 * (x - x[0])[None, :, None] - 0.2 * (y - y[0])[:, None, None] + np.zeros(BINS)
    volume = LikelihoodVolume(plane.astype(np.float32), GRID)
    rng = np.random.default_rng(4)
    poses = rng.uniform([100.0, -20.0, -4.0], [103.5, -15.5, 4.0], (500, 3))
    inner = np.clip(poses[:, 0], x[0], x[-1]), np.clip(poses[:, 1], y[-1], y[0])
    expected = 0.3 * (inner[0] - x[0]) - 0.2 * (inner[1] - y[0])
    np.testing.assert_allclose(volume.log_density(poses), expected, atol=1e-5)


def test_yaw_is_interpolated_round_the_circle():
    log_prob = np.full((GRID.rows, GRID.cols, BINS), -5.0, dtype=np.float32)
    log_prob[..., 0], log_prob[..., BINS - 1] = 1.0, 2.0
    volume = LikelihoodVolume(log_prob, GRID)
    step = 2 * np.pi / BINS
    at = [[101.0, -18.0, -0.25 * step], [101.0, -18.0, 2 * np.pi - 0.25 * step], [101.0, -18.0, -step]]
    np.testing.assert_allclose(volume.log_density(at), [1.25, 1.25, 2.0], atol=1e-6)


@given(st.floats(-10.0, 10.0), st.integers(-3, 3))
@settings(max_examples=30, deadline=None)
def test_full_turns_change_nothing(yaw, turns):
    volume = LikelihoodVolume.from_scores(random_scores(5), GRID)
    here = volume.log_density([[101.2, -17.3, yaw], [101.2, -17.3, yaw + turns * 2 * np.pi]])
    assert here[0] == pytest.approx(here[1], abs=1e-9)


def test_outside_is_the_floor_and_with_outliers_the_uniform_share():
    volume = LikelihoodVolume.from_scores(random_scores(6), GRID)
    outside = [[99.9, -18.0, 0.0], [1e6, 1e6, 1.0]]
    np.testing.assert_array_equal(volume.log_density(outside), volume.floor)
    uniform = -np.log(GRID.area_m2 * 2 * np.pi)
    np.testing.assert_allclose(volume.with_outliers(0.1).log_density(outside), np.log(0.1) + uniform)
    assert log_uniform_density(GRID) == pytest.approx(uniform)


def test_outliers_mix_as_the_formula_says_and_twice_is_both_chances():
    volume = LikelihoodVolume.from_scores(random_scores(7), GRID)
    density, uniform = np.exp(volume.log_density(centres())), np.exp(log_uniform_density(GRID))
    mixed = np.exp(volume.with_outliers(0.2).log_density(centres()))
    np.testing.assert_allclose(mixed, 0.8 * density + 0.2 * uniform, rtol=1e-9)
    twice = np.exp(volume.with_outliers(0.2).with_outliers(0.5).log_density(centres()))
    np.testing.assert_allclose(twice, 0.5 * mixed + 0.5 * uniform, rtol=1e-9)
    np.testing.assert_array_equal(volume.with_outliers(0.0).log_density(centres()), volume.log_density(centres()))


def test_tempering_leaves_what_was_not_evaluated_at_the_floor():
    valid = np.arange(BINS) < 3
    volume = LikelihoodVolume.from_scores(random_scores(8), GRID, valid=valid)
    tempered = volume.tempered(19.0)
    assert (tempered.log_prob[..., ~valid] == tempered.floor).all()
    expected = LikelihoodVolume.from_scores(random_scores(8), GRID, temperature=19.0, valid=valid)
    np.testing.assert_allclose(tempered.log_prob[..., valid], expected.log_prob[..., valid], atol=1e-5)
    assert volume.tempered(1.0) is volume


def assert_drawn_from(poses, volume):
    """Chi-square test of the cells that poses fall in against the volume's masses, and of the cells' insides."""
    row_col = np.floor(GRID.pixel_from_xy(poses[:, :2])).astype(int)
    yaw_bin = np.floor(poses[:, 2] / (2 * np.pi / BINS) + 0.5).astype(int) % BINS
    cell = np.ravel_multi_index((row_col[:, 0], row_col[:, 1], yaw_bin), volume.log_prob.shape)
    expected = len(poses) * np.exp(volume.log_prob.astype(np.float64).reshape(-1)) * cell_volume()
    counts = np.bincount(cell, minlength=expected.size)
    common = expected > 5
    statistic = ((counts[common] - expected[common]) ** 2 / expected[common]).sum()
    assert statistic < chi2.ppf(0.999, common.sum())
    assert statistic > chi2.ppf(0.001, common.sum())
    inside = GRID.pixel_from_xy(poses[:, :2]) % 1.0
    np.testing.assert_allclose(inside.mean(axis=0), 0.5, atol=4 * np.sqrt(1 / 12 / len(poses)))
    np.testing.assert_allclose(inside.var(axis=0), 1 / 12, rtol=0.05)


@pytest.mark.parametrize("some_bins_only", [False, True])
def test_samples_follow_the_volume(some_bins_only):
    valid = np.isin(np.arange(BINS), [0, 1, BINS - 1]) if some_bins_only else None
    volume = LikelihoodVolume.from_scores(random_scores(9), GRID, valid=valid)
    poses = volume.sample(40_000, np.random.default_rng(10))
    assert (np.abs(poses[:, 2]) <= np.pi).all()
    assert_drawn_from(poses, volume)


def test_samples_of_an_outlier_mixture_follow_the_mixture():
    volume = LikelihoodVolume.from_scores(random_scores(11), GRID)
    mixture = volume.with_outliers(0.4)
    as_volume = LikelihoodVolume(mixture.log_density(centres()).reshape(volume.log_prob.shape), GRID)
    assert_drawn_from(mixture.sample(40_000, np.random.default_rng(12)), as_volume)


def test_same_seed_same_samples():
    volume = LikelihoodVolume.from_scores(random_scores(13), GRID).with_outliers(0.1)
    first, second = (volume.sample(50, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def factored(seed):
    rng = np.random.default_rng(seed)
    location = rng.normal(0.0, 1.0, (GRID.rows, GRID.cols))
    location -= np.log(np.exp(location).sum() * GRID.metres_per_pixel**2)
    orientation = rng.normal(0.0, 1.0, (BINS, GRID.rows, GRID.cols))
    orientation -= np.log(np.exp(orientation).sum(axis=0) * 2 * np.pi / BINS)
    return LocationOrientationMaps(location.astype(np.float32), orientation.astype(np.float32), GRID, 0.8)


def test_location_orientation_is_the_volume_it_factors():
    maps = factored(0)
    poses = np.random.default_rng(1).uniform([99.0, -21.0, -4.0], [104.0, -15.0, 4.0], (300, 3))
    np.testing.assert_allclose(maps.log_density(poses), maps.to_volume().log_density(poses), atol=1e-5)
    assert quadrature(maps) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("temperature", [0.5, 3.0, 40.0])
def test_tempered_location_orientation_still_factors(temperature):
    maps = factored(2)
    tempered = maps.tempered(temperature)
    joint = maps.to_volume().tempered(temperature)
    np.testing.assert_allclose(tempered.to_volume().log_prob, joint.log_prob, atol=1e-4)
    headings = np.exp(tempered.orientation.astype(np.float64)).sum(axis=0) * 2 * np.pi / BINS
    np.testing.assert_allclose(headings, 1.0, atol=1e-5)
    assert tempered.confidence == maps.confidence


def test_samples_follow_location_orientation():
    maps = factored(3)
    assert_drawn_from(maps.sample(40_000, np.random.default_rng(4)), maps.to_volume())


def test_a_gaussian_likelihood_is_tempered_by_its_covariance():
    covariance = np.array([[1.0, 0.3, 0.0], [0.3, 2.0, 0.01], [0.0, 0.01, 0.02]])
    gaussian = GaussianLikelihood(np.array([101.0, -18.0, 3.1]), covariance, GRID)
    poses = gaussian.sample(20_000, np.random.default_rng(6))
    _, spread = se2.weighted_mean_and_covariance(poses, np.ones(len(poses)))
    np.testing.assert_allclose(spread, covariance, atol=0.06)
    difference = gaussian.log_density(poses[:50]) - gaussian.log_density(gaussian.mean[None])
    tempered = gaussian.tempered(4.0)
    np.testing.assert_allclose(
        tempered.log_density(poses[:50]) - tempered.log_density(gaussian.mean[None]), difference / 4.0, atol=1e-9
    )
    assert gaussian.log_density([[1e9, 0.0, 0.0]])[0] == gaussian.floor


def test_bad_values_are_refused():
    good = random_scores(14)
    bad = good.copy()
    bad[0, 0, 0] = np.nan
    for name, call in {
        "finite": lambda: LikelihoodVolume(bad, GRID),
        "finite values at the valid": lambda: LikelihoodVolume.from_scores(bad, GRID),
        "scores: expected": lambda: LikelihoodVolume.from_scores(good[1:], GRID),
        "likelihood: expected": lambda: LikelihoodVolume(good[..., 0], GRID),
        "above the floor": lambda: LikelihoodVolume(np.full_like(good, -50.0), GRID),
        "valid": lambda: LikelihoodVolume.from_scores(good, GRID, valid=np.ones(5, dtype=bool)),
        "at least one": lambda: LikelihoodVolume.from_scores(good, GRID, valid=np.zeros(BINS, dtype=bool)),
        "temperature": lambda: LikelihoodVolume.from_scores(good, GRID, temperature=0.0),
        "temperature: ": lambda: LikelihoodVolume.from_scores(good, GRID).tempered(np.nan),
        "outlier": lambda: LikelihoodVolume.from_scores(good, GRID).with_outliers(1.0),
        "poses": lambda: LikelihoodVolume.from_scores(good, GRID).log_density([[np.nan, 0.0, 0.0]]),
        "location": lambda: LocationOrientationMaps(np.zeros((2, 2)), np.zeros((4, 9, 7)), GRID),
        "orientation": lambda: LocationOrientationMaps(np.zeros((9, 7)), np.zeros((9, 7, 4)), GRID),
        "confidence": lambda: LocationOrientationMaps(np.zeros((9, 7)), np.zeros((4, 9, 7)), GRID, 1.5),
    }.items():
        with pytest.raises(SkyfixError, match=name) as caught:
            call()
        assert "\n" not in str(caught.value)
