"""Resampling: unbiased, exact in number, and safe with the weights that filters really have."""

import filterpy.monte_carlo.resampling
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import chi2

from fusion import SkyfixError
from fusion.resampling import RESAMPLERS, effective_sample_size, systematic

every_scheme = pytest.mark.parametrize("name", sorted(RESAMPLERS))
some_weights = arrays(np.float64, st.integers(1, 60), elements=st.floats(0.0, 1e6)).filter(lambda w: w.sum() > 0)


@every_scheme
@given(weights=some_weights, n=st.integers(0, 100), seed=st.integers(0, 1000))
@settings(max_examples=40)
def test_indices_are_n_sorted_and_never_of_weight_zero(name, weights, n, seed):
    chosen = RESAMPLERS[name](weights, n, np.random.default_rng(seed))
    assert chosen.shape == (n,)
    assert chosen.dtype == np.int64
    assert (np.diff(chosen) >= 0).all()
    assert (weights[chosen] > 0).all()


@every_scheme
def test_copies_are_unbiased(name):
    weights = np.array([0.35, 0.0, 0.05, 0.211, 0.389])
    rng, n, rounds = np.random.default_rng(0), 7, 6000
    counts = np.array([np.bincount(RESAMPLERS[name](weights, n, rng), minlength=5) for _ in range(rounds)])
    error = np.sqrt(n * weights * (1 - weights) / rounds)  # of the multinomial, the widest of the four
    assert (np.abs(counts.mean(axis=0) - n * weights) <= 4.5 * error + 1e-12).all()


def test_schemes_differ_in_variance_as_theory_says():
    weights = np.random.default_rng(1).dirichlet(np.ones(30))
    rng = np.random.default_rng(2)
    spread = {
        name: np.var([np.bincount(scheme(weights, 30, rng), minlength=30) for _ in range(2000)], axis=0).sum()
        for name, scheme in RESAMPLERS.items()
    }
    assert spread["systematic"] < spread["multinomial"]
    assert spread["stratified"] < 0.8 * spread["multinomial"]
    assert spread["residual"] < 0.8 * spread["multinomial"]


@given(some_weights, st.integers(1, 100), st.integers(0, 100))
def test_systematic_gives_every_particle_its_share_rounded(weights, n, seed):
    counts = np.bincount(systematic(weights, n, np.random.default_rng(seed)), minlength=len(weights))
    share = n * weights / weights.sum()
    assert (counts >= np.floor(share - 1e-6)).all()
    assert (counts <= np.ceil(share + 1e-6)).all()


@pytest.mark.parametrize("seed", range(20))
def test_systematic_is_filterpy_s_for_the_same_offset(seed, monkeypatch):
    offset = np.random.default_rng(seed).random()
    monkeypatch.setattr(filterpy.monte_carlo.resampling, "random", lambda: offset)
    weights = np.random.default_rng(100 + seed).dirichlet(np.full(500, 0.2))
    expected = filterpy.monte_carlo.systematic_resample(weights)
    np.testing.assert_array_equal(systematic(weights, 500, np.random.default_rng(seed)), expected)


class LastOffset(np.random.Generator):
    """Draws the largest number below 1."""

    def __init__(self):
        super().__init__(np.random.PCG64(0))

    def random(self):
        return np.nextafter(1.0, 0.0)


def test_systematic_holds_where_filterpy_s_runs_off_the_end(monkeypatch):
    weights = np.random.default_rng(5).dirichlet(np.ones(10)) * (1 - 1e-9)
    monkeypatch.setattr(filterpy.monte_carlo.resampling, "random", LastOffset().random)
    with pytest.raises(IndexError):
        filterpy.monte_carlo.systematic_resample(weights)
    counts = np.bincount(systematic(weights, 10, LastOffset()), minlength=10)
    assert counts.sum() == 10
    assert (np.abs(counts - 10 * weights) < 1.0).all()


@every_scheme
def test_weights_that_sum_to_slightly_less_or_more_than_one(name):
    weights = np.full(100_000, 1e-5) * (1 - 1e-9)
    chosen = RESAMPLERS[name](weights, 100_000, np.random.default_rng(3))
    assert chosen.max() <= 99_999
    assert len(RESAMPLERS[name](weights * 1.001, 10, np.random.default_rng(3))) == 10


@every_scheme
@pytest.mark.parametrize("weights", [[0.0, 0.0], [], [0.5, np.nan], [0.5, -0.1], [np.inf, 1.0]])
def test_weights_without_meaning_are_refused_instead_of_becoming_nan(name, weights):
    with pytest.raises(SkyfixError, match="weights"):
        RESAMPLERS[name](np.array(weights), 5, np.random.default_rng(0))


@every_scheme
def test_same_seed_same_indices(name):
    weights = np.random.default_rng(4).random(50)
    first, second = (RESAMPLERS[name](weights, 50, np.random.default_rng(9)) for _ in range(2))
    np.testing.assert_array_equal(first, second)


@given(st.integers(1, 1000), st.floats(-2000.0, 2000.0))
def test_effective_sample_size_of_equal_weights_is_their_number(n, shift):
    assert effective_sample_size(np.full(n, shift)) == pytest.approx(n)


def test_effective_sample_size_of_one_heavy_particle_is_one():
    assert effective_sample_size([0.0, -1000.0, -2000.0]) == pytest.approx(1.0)
    assert effective_sample_size(np.log([0.5, 0.25, 0.25])) == pytest.approx(1.0 / (0.25 + 0.0625 + 0.0625))


def bias_probability(copies, expected):
    """p of Hotelling's chi-squared test that copies (runs, N) have their expected mean (N,)."""
    off = copies - expected
    covariance = np.cov(off.T)
    values, vectors = np.linalg.eigh(covariance)
    kept = values > 1e-9 * values[-1]
    scores = vectors[:, kept].T @ off.mean(axis=0)
    return chi2.sf(len(copies) * (scores**2 / values[kept]).sum(), kept.sum())


@pytest.mark.parametrize("name", sorted(RESAMPLERS))
def test_no_scheme_is_biased_by_a_chi_squared_test(name):
    """6,000 runs of 7 from 6; the test finds 0.1 copies moved from one particle to another with power above 0.999."""
    rng, runs, n = np.random.default_rng(11), 6000, 7
    weights = np.array([0.05, 0.31, 0.02, 0.22, 0.27, 0.13])
    copies = np.array([np.bincount(RESAMPLERS[name](weights, n, rng), minlength=6) for _ in range(runs)], dtype=float)
    assert bias_probability(copies, n * weights) > 1e-3
    moved = n * weights + 0.1 * np.array([1.0, -1.0, 0.0, 0.0, 0.0, 0.0])
    assert bias_probability(copies, moved) < 1e-6


@pytest.mark.parametrize("seed", range(5))
def test_stratified_is_filterpy_s_for_the_same_points(seed, monkeypatch):
    weights = np.random.default_rng(seed).dirichlet(np.ones(50))
    points = np.random.default_rng(seed + 100).random(50)

    class Fixed:
        def random(self, n):
            return points[:n]

    monkeypatch.setattr(filterpy.monte_carlo.resampling, "random", lambda n: points[:n])
    expected = filterpy.monte_carlo.stratified_resample(weights)
    np.testing.assert_array_equal(RESAMPLERS["stratified"](weights, 50, Fixed()), expected)
