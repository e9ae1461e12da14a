"""A heading head that is worked out where it is asked: the same density as when it is worked out everywhere."""

import numpy as np
import pytest

from fusion import LazyOrientation, MapGrid, OdometryIncrement, ParticleFilter, ParticleFilterSettings, SkyfixError

GRID = MapGrid(31, 27, 0.5, -7.0, 2.0)
RNG = np.random.default_rng(0)
LOCATION = RNG.normal(size=(31, 27))
LOCATION -= np.log(np.exp(LOCATION).sum() * 0.25)
HEAD = {"features": RNG.normal(size=(5, 31, 27)), "weights": RNG.normal(size=(16, 5)), "bias": RNG.normal(size=16)}
LAZY = LazyOrientation(LOCATION, grid=GRID, **HEAD)


SHARP = LazyOrientation(
    -0.5 * ((np.arange(100)[:, None] - 60.3) ** 2 + (np.arange(100) - 41.8) ** 2) / 4.0
    - np.log(2.0 * np.pi * 4.0 * 0.25),
    RNG.normal(size=(5, 100, 100)),
    3.0 * RNG.normal(size=(72, 5)),
    RNG.normal(size=72),
    MapGrid(100, 100, 0.5, -20.0, -25.0),
)
"""A location map with one peak, two pixels wide."""


def poses(count=3000):
    return np.random.default_rng(1).uniform([-9.0, 0.0, -np.pi], [9.0, 20.0, np.pi], (count, 3))


def test_densities_are_those_of_the_whole_maps():
    whole = LAZY.to_maps()
    np.testing.assert_allclose(LAZY.log_density(poses()), whole.log_density(poses()), atol=1e-5)
    np.testing.assert_allclose(LAZY.draw_log_density(poses()), whole.draw_log_density(poses()), atol=1e-5)
    few = poses(1)
    np.testing.assert_allclose(LAZY.log_density(few), whole.log_density(few), atol=1e-5)
    assert LAZY.log_density(np.zeros((0, 3))).shape == (0,)
    assert LAZY.searched_volume == whole.searched_volume
    cells = 31 * 27 * 16
    assert np.exp(whole.to_volume().log_prob).sum() * whole.to_volume().cell_volume == pytest.approx(1.0, abs=1e-4)
    assert whole.to_volume().log_prob.size == cells


@pytest.fixture
def asked(monkeypatch):
    """How many pixels' headings were asked for, a call each."""
    counts = []
    inner = LazyOrientation.headings_at

    def headings_at(self, pixels):
        counts.append(len(pixels))
        return inner(self, pixels)

    monkeypatch.setattr(LazyOrientation, "headings_at", headings_at)
    return counts


def test_only_the_pixels_around_the_poses_are_worked_out(asked):
    LAZY.lookup_near(np.array([[0.1, 10.1, 0.3]]))
    LAZY.lookup_near(poses())
    assert asked == [9, 31 * 27]


def near_the_peak(count=2000):
    """Poses around the peak of `SHARP`, a few far from it and a few outside."""
    rng = np.random.default_rng(2)
    near = rng.normal([1.15, -5.4, 0.0], [1.0, 1.0, 2.0], (count, 3))
    return np.concatenate([near, rng.uniform([-24.0, -29.0, -np.pi], [34.0, 29.0, np.pi], (50, 3))])


@pytest.mark.parametrize("temperature", [0.3, 0.8, 1.5, 4.0])
@pytest.mark.parametrize("lazy", [LAZY, SHARP])
def test_tempered_it_is_the_whole_maps_tempered(lazy, temperature):
    """Density, draws, composition: all to the precision of float32, whatever was left out of the normaliser."""
    some, whole, at = lazy.tempered(temperature), lazy.to_maps().tempered(temperature), near_the_peak()
    if lazy is LAZY:
        at = poses()
    close = {"rtol": 1e-5, "atol": 1e-4}
    np.testing.assert_allclose(some.log_density(at), whole.log_density(at), **close)
    np.testing.assert_allclose(some.draw_log_density(at), whole.draw_log_density(at), **close)
    np.testing.assert_allclose(some.to_maps().orientation, whole.orientation, atol=1e-4)
    np.testing.assert_allclose(some.tempered(1.3).log_density(at), whole.tempered(1.3).log_density(at), **close)
    assert some.tempered(1.0) is some
    lookups = lazy.lookup_near(at, temperature), lazy.to_maps().lookup(temperature)
    assert lookups[0].scale == lookups[1].scale
    assert lookups[0].shift == pytest.approx(lookups[1].shift, abs=1e-4)


@pytest.mark.parametrize("temperature", [0.5, 1.5, 3.0])
def test_tempered_it_leaves_out_the_pixels_that_hold_no_mass(asked, temperature):
    """A filter's step and draws on a peaked map of 10,000 pixels: those around the particles and under the peak."""
    particles = ParticleFilter(near_the_peak(200)[:200], 3, ParticleFilterSettings(guided_below=0.0))
    particles.update(SHARP, temperature)
    likelihood = SHARP.tempered(temperature)
    likelihood.log_density(near_the_peak(200)[:200])
    likelihood.sample(100, np.random.default_rng(0))
    assert max(asked) < 600
    assert sum(asked) < 4000


@pytest.mark.parametrize("temperature", [1.0, 3.0])
def test_a_filter_goes_the_same_way_by_either(temperature):
    ways = []
    for likelihood in (LAZY, LAZY.to_maps()):
        particles = ParticleFilter(poses(2000), 3)
        for step in range(3):
            particles.predict(OdometryIncrement(step, np.array([0.1, 0.0, 0.1]), np.diag([0.1, 0.1, 0.05]) ** 2))
            evidence = particles.update(likelihood, temperature).log_evidence
        ways.append((evidence, particles.estimate(0).pose))
    assert ways[0][0] == pytest.approx(ways[1][0], abs=1e-3)
    np.testing.assert_allclose(ways[0][1], ways[1][1], atol=1e-2)


@pytest.mark.parametrize("temperature", [1.0, 2.0])
def test_samples_have_the_density_that_is_stated(temperature):
    """Means of the inverse density over what was drawn are volumes: of the whole, and of a half."""
    likelihood = LAZY.tempered(temperature)
    drawn = likelihood.sample(40_000, np.random.default_rng(4))
    volume = likelihood.searched_volume
    inverse = np.exp(-likelihood.draw_log_density(drawn)) / volume
    for part in (np.ones(len(drawn)), drawn[:, 2] > 0.0, drawn[:, 0] > GRID.centre_xy[0]):
        values = inverse * part
        expected = 1.0 if part.all() else 0.5
        assert values.mean() == pytest.approx(expected, abs=4.5 * values.std() / 200.0)


@pytest.mark.parametrize(
    ("word", "change"),
    [
        ("location", {"location": LOCATION[1:]}),
        ("features", {"features": np.full((5, 31, 27), np.nan)}),
        ("weights: expected \\(16, 5\\)", {"weights": np.ones((16, 4))}),
        ("bias", {"bias": np.ones((16, 1))}),
        ("floor", {"floor": np.inf}),
    ],
)
def test_bad_input_is_one_line(word, change):
    with pytest.raises(SkyfixError, match=word) as caught:
        LazyOrientation(**({"location": LOCATION, "grid": GRID, **HEAD} | change))
    assert "\n" not in str(caught.value)
