"""The compiled step: known answers, the accuracy it states, and nothing that depends on threads or on looking."""

import numba
import numpy as np
import pytest

from fusion import (
    LikelihoodVolume,
    LocationOrientationMaps,
    MapGrid,
    OdometryIncrement,
    ParticleFilter,
    ParticleFilterSettings,
    se2,
)
from fusion.kernels.float_math import KERNEL, exp, log, sine_cosine
from fusion.kernels.likelihood_mass import survey, tempered_mass
from fusion.kernels.random import U, normal_pair, threefry
from fusion.particles.cloud import Cloud, lower_root

KEY = np.array([1, 2, 3, 4], np.uint32)
GRID = MapGrid(23, 17, 0.5, -4.0, 3.0)
BINS = 12
UNCACHED = {**KERNEL, "cache": False}


@numba.njit(**UNCACHED)
def words(counter, key):
    return threefry(
        (counter[0], counter[1], counter[2], counter[3]),
        (key[0], key[1], key[2], key[3]),
    )


@numba.njit(**UNCACHED)
def elementary(x, positive, result):
    for j in range(len(x)):
        result[0, j] = exp(x[j])
        result[1, j] = log(positive[j])
        sine, cosine = sine_cosine(x[j])
        result[2, j], result[3, j] = sine, cosine


@numba.njit(**UNCACHED)
def normals(count, epoch, key, result):
    for j in range(count):
        a, b, c, d = threefry((U(j), epoch, U(0), U(0)), (key[0], key[1], key[2], key[3]))
        result[0, j], result[1, j] = normal_pair(a, d)
        result[2, j], result[3, j] = normal_pair(b, U(d >> U(10)))
        result[4, j], result[5, j] = normal_pair(c, U(d >> U(20)))


@pytest.mark.parametrize(
    ("counter", "key", "expected"),
    [
        ((0, 0, 0, 0), (0, 0, 0, 0), (0x531C7E4F, 0x39491EE5, 0x2C855A92, 0x3D6ABF9A)),
        ((2**32 - 1,) * 4, (2**32 - 1,) * 4, (0xC4189358, 0x1C9CC83A, 0xD5881C67, 0x6A0A89E0)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0, 0x082EFA98, 0xEC4E6C89),
            (0x4AA71D8F, 0x734738C2, 0x431FC6A8, 0xAE6DEBF1),
        ),
    ],
)
def test_the_generator_gives_its_authors_known_answers(counter, key, expected):
    """The vectors that Random123 is distributed with, for 13 rounds."""
    assert words(np.array(counter, np.uint32), np.array(key, np.uint32)) == expected


def test_normals_are_normal_and_independent():
    count, drawn = 200_000, []
    for epoch in range(2):
        result = np.empty((6, count), np.float32)
        normals(count, U(epoch), KEY, result)
        drawn.append(result.astype(np.float64))
    e = np.concatenate(drawn)  # six of each epoch: twelve series
    limit = 4.5 / np.sqrt(count)
    assert (np.abs(e.mean(axis=1)) < limit).all()
    assert (np.abs(e.var(axis=1) - 1.0) < np.sqrt(2.0) * limit).all()
    assert (np.abs((e**3).mean(axis=1)) < np.sqrt(15.0) * limit).all()
    assert (np.abs((e**4).mean(axis=1) - 3.0) < np.sqrt(96.0) * limit).all()
    off_diagonal = np.corrcoef(e) - np.eye(12)
    assert np.abs(off_diagonal).max() < limit
    assert np.abs(np.corrcoef(e**2) - np.eye(12)).max() < limit  # pairs share a radius, not a square
    assert np.abs((e[:, 1:] * e[:, :-1]).mean(axis=1)).max() < limit  # particle to particle
    beyond = (np.abs(e) > 3.0).mean()
    assert beyond == pytest.approx(0.0026998, rel=0.06)


def test_elementary_functions_are_as_accurate_as_they_say():
    x = np.linspace(-np.pi, np.pi, 100_001).astype(np.float32)
    positive = np.exp(np.linspace(-80.0, 80.0, 100_001)).astype(np.float32)
    result = np.empty((4, len(x)), np.float32)
    elementary(x, positive, result)
    wide, logarithm = x.astype(np.float64), np.log(positive.astype(np.float64))
    np.testing.assert_allclose(result[0], np.exp(wide), rtol=1e-6)
    np.testing.assert_allclose(result[1], logarithm, rtol=1.2e-7, atol=5e-7)
    np.testing.assert_allclose(result[2], np.sin(wide), atol=4e-7)
    np.testing.assert_allclose(result[3], np.cos(wide), atol=4e-7)
    far = np.array([-1e30, -100.0, 100.0, 1e30], np.float32)
    elementary(far, np.ones(4, np.float32), result := np.empty((4, 4), np.float32))
    assert np.isfinite(result[0]).all()
    assert (result[1] == 0.0).all()


def scores(seed):
    return np.random.default_rng(seed).normal(0.0, 3.0, (GRID.rows, GRID.cols, BINS))


def volume(seed=0, headings=None):
    valid = None if headings is None else np.isin(np.arange(BINS), headings)
    return LikelihoodVolume.from_scores(scores(seed), GRID, valid=valid)


def maps(seed=0):
    joint = scores(seed) / 3.0
    location = joint.max(axis=2)
    location -= np.log(np.exp(location).sum() * GRID.metres_per_pixel**2)
    orientation = np.moveaxis(joint, 2, 0)
    orientation = orientation - np.log(np.exp(orientation).sum(axis=0) * se2.TWO_PI / BINS)
    return LocationOrientationMaps(location.astype(np.float32), orientation.astype(np.float32), GRID)


@pytest.mark.parametrize("temperature", [1.0, 0.7, 2.5, 19.0])
@pytest.mark.parametrize(
    "likelihood", [volume(), volume(1, [0, 1, 2, 11]), volume(2, [6]), maps(3)], ids=["all", "seam", "one", "maps"]
)
def test_the_compiled_lookup_is_the_likelihood_s_own(likelihood, temperature):
    """Tempered, with outliers, inside, at the edges, across the seam of headings and outside of the crop."""
    rng = np.random.default_rng(5)
    poses = rng.uniform([-6.0, 1.0, -np.pi], [7.0, 17.0, np.pi], (4000, 3))
    poses[:50, 2] = np.linspace(-np.pi, -np.pi + 1e-3, 50)
    cloud = Cloud(poses, None, KEY)
    poses = cloud.poses()  # as rounded
    evidence = cloud.weigh(likelihood.lookup(temperature), 0.05)
    expected = likelihood.tempered(temperature).with_outliers(0.05).log_density(poses)
    np.testing.assert_allclose(cloud.log_weights() + np.log(len(poses)) + evidence, expected, atol=2e-3, rtol=1e-4)
    assert np.median(np.abs(cloud.log_weights() + np.log(len(poses)) + evidence - expected)) < 2e-5
    assert evidence == pytest.approx(np.log(np.exp(expected).mean()), abs=1e-4)


def test_survey_and_mass_are_numpy_s():
    values = np.random.default_rng(6).normal(0.0, 5.0, (999, 7)).astype(np.float32)
    values[3, 2] = 20.0
    peaks, evaluated, bad = survey(values, np.float32(-2.0))
    np.testing.assert_array_equal(peaks, values.max(axis=0))
    assert (evaluated, bad) == ((values > -2.0).sum(), 0)
    values[5, 5], values[6, 6], values[7, 0] = np.nan, np.inf, -np.inf
    assert survey(values, np.float32(-2.0))[2] == 3
    flat = np.random.default_rng(7).normal(0.0, 5.0, 9000).astype(np.float32)
    mass, least = tempered_mass(flat, np.float32(-2.0), np.float32(flat.max()), np.float32(0.4))
    used = flat[flat > -2.0].astype(np.float64)
    assert mass == pytest.approx(np.exp((used - flat.max()) * 0.4).sum(), rel=1e-5)
    assert least == used.min()


@pytest.mark.parametrize("spread", [0.0, 0.3, 3.0, 30.0])
@pytest.mark.parametrize(("count", "copies"), [(1, 1), (7, 100), (511, 511), (512, 3), (3000, 3000), (3000, 17)])
@pytest.mark.parametrize("offset", [0.0, 0.37, 0.999])
def test_ancestors_are_those_of_systematic_resampling(spread, count, copies, offset):
    """Every particle gets its share of the copies rounded down or up, and the copies lie where they should."""
    log_weights = np.random.default_rng(count).normal(0.0, spread, count)
    cloud = Cloud(np.arange(3.0 * count).reshape(count, 3) / count, log_weights, KEY)
    cloud.resample(copies, offset)
    chosen = cloud._ancestors
    edges = np.cumsum(np.exp(log_weights - log_weights.max()))
    edges = np.concatenate([[0.0], edges * copies / edges[-1]])
    points = np.arange(copies) + offset
    slack = 1e-6 * copies
    assert (np.diff(chosen) >= 0).all()
    assert (edges[chosen] <= points + slack).all()
    assert (edges[chosen + 1] >= points - slack).all()


@pytest.mark.parametrize("count", [1, 1023, 1024, 1025, 5000])
@pytest.mark.parametrize("spread", [0.02, 1.0, 3.0])
def test_moments_are_those_of_float64(count, spread):
    """Tight and wide clouds, far from where they began, headings over the seam and all round."""
    rng = np.random.default_rng(count)
    poses = np.array([5000.0, -3000.0, np.pi]) + rng.normal(size=(count, 3)) * [20 * spread, 3 * spread, spread]
    poses[:, 2] = se2.wrap(poses[:, 2])
    log_weights = rng.normal(size=count) - 700.0
    cloud = Cloud(poses, log_weights, KEY)
    weights = np.exp(cloud.log_weights())
    mean, covariance = se2.weighted_mean_and_covariance(cloud.poses(), weights)
    moments = cloud.moments()
    sigma = np.sqrt(np.diag(covariance)) + 1e-6
    off = np.array(moments.mean) + [*cloud.anchor, 0.0] - mean
    off[2] = se2.wrap(off[2])
    assert (np.abs(off) < 2e-5 * sigma + 1e-6).all()
    np.testing.assert_allclose(
        moments.covariance / np.outer(sigma, sigma), covariance / np.outer(sigma, sigma), atol=1e-4
    )
    assert moments.effective_sample_size == pytest.approx(1.0 / (weights**2).sum(), rel=1e-5)


def drive(threads, looking, count=20_000, **settings):
    """Twelve steps with resampling, kernel noise, a change of anchor and a measurement now and then."""
    rng = np.random.default_rng(8)
    cloud = rng.normal([0.0, 9.0, 0.1], [1.0, 1.0, 0.2], (count, 3))
    chosen = ParticleFilterSettings(threads=threads, ess_fraction=0.9, **settings)
    particles, seen = ParticleFilter(cloud, 9, chosen), volume()
    for step in range(12):
        noise = np.diag([0.05, 0.05, 0.01]) ** 2
        particles.predict(OdometryIncrement(step, np.array([0.05, 0.0, 0.02]), noise))
        if looking:
            particles.particles, particles.log_weights, particles.estimate(step)
        if step % 3 != 2:
            particles.update(seen, 1.0 + 0.1 * step)
            if looking:
                particles.particles, particles.log_weights, particles.estimate(step)
    estimate = particles.estimate(0)
    return particles.particles, particles.log_weights, estimate.pose, estimate.covariance


def test_one_thread_and_several_agree_bit_for_bit():
    one = drive(1, looking=False)
    for threads in (2, 3):
        for a, b in zip(one, drive(threads, looking=False), strict=True):
            np.testing.assert_array_equal(a, b)


def test_looking_at_a_filter_does_not_change_it():
    for a, b in zip(drive(1, looking=False), drive(1, looking=True), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_anchor_follows_a_long_drive_without_losing_precision():
    particles = ParticleFilter(np.tile([0.3, 0.1, 0.0], (10, 1)), 0)
    for step in range(300):
        particles.predict(OdometryIncrement(step, np.array([7.0, 0.0, 0.0]), np.zeros((3, 3))))
    np.testing.assert_allclose(particles.particles, np.tile([2100.3, 0.1, 0.0], (10, 1)), atol=2e-4)


@pytest.mark.parametrize("seed", range(5))
def test_lower_root_of_definite_and_semidefinite_matrices(seed):
    a = np.random.default_rng(seed).normal(size=(3, 3))
    for covariance in (a @ a.T, np.outer(a[0], a[0]), np.zeros((3, 3)), np.diag([0.0, 2.0, 0.0])):
        root = np.array(lower_root(covariance.tolist())).reshape(3, 3)
        np.testing.assert_allclose(root @ root.T, covariance, atol=2e-7)
        assert (np.triu(root, 1) == 0.0).all()
