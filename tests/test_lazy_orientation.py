"""A heading head that is worked out where it is asked: the same density as when it is worked out everywhere."""

import numpy as np
import pytest

from fusion import LazyOrientation, MapGrid, OdometryIncrement, ParticleFilter, SkyfixError

GRID = MapGrid(31, 27, 0.5, -7.0, 2.0)
RNG = np.random.default_rng(0)
LOCATION = RNG.normal(size=(31, 27))
LOCATION -= np.log(np.exp(LOCATION).sum() * 0.25)
HEAD = {"features": RNG.normal(size=(5, 31, 27)), "weights": RNG.normal(size=(16, 5)), "bias": RNG.normal(size=16)}
LAZY = LazyOrientation(LOCATION, grid=GRID, **HEAD)


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


def test_only_the_pixels_around_the_poses_are_worked_out(monkeypatch):
    asked = []
    inner = LazyOrientation.headings_at

    def headings_at(self, pixels):
        asked.append(len(pixels))
        return inner(self, pixels)

    monkeypatch.setattr(LazyOrientation, "headings_at", headings_at)
    LAZY.lookup_near(np.array([[0.1, 10.1, 0.3]]))
    LAZY.lookup_near(poses())
    assert asked == [9, 31 * 27]


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


def test_samples_have_the_density_that_is_stated():
    """Means of the inverse density over what was drawn are volumes: of the whole, and of a half."""
    drawn = LAZY.sample(40_000, np.random.default_rng(4))
    volume = LAZY.searched_volume
    inverse = np.exp(-LAZY.draw_log_density(drawn)) / volume
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
