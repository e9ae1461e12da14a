"""A particle filter's state: a copy from which it goes on bit for bit."""

from dataclasses import replace

import numpy as np
import pytest

from fusion import (
    GaussianLikelihood,
    MapGrid,
    OdometryIncrement,
    ParticleFilter,
    ParticleFilterSettings,
    SkyfixError,
    UniformPrior,
)

GRID = MapGrid(81, 81, 0.5, -20.25, -20.25)
PRIOR = UniformPrior(np.zeros(3), 10.0, 0.5)
STEP = OdometryIncrement(1, np.array([0.5, 0.0, 0.01]), np.diag([0.1, 0.1, 0.01]) ** 2)
NEAR, FAR = (GaussianLikelihood(np.array([x, 0.0, 0.0]), np.diag([0.5, 0.5, 0.05]) ** 2, GRID) for x in (0.0, 18.0))


def drive(particles, steps=6):
    """Steps with resampling, and an injection where the measurement is far off."""
    for step in range(steps):
        particles.predict(STEP)
        particles.update(FAR if step % 5 > 2 else NEAR)
    estimate = particles.estimate(0)
    return particles.particles.copy(), particles.log_weights.copy(), estimate.pose, particles.lost_score


@pytest.mark.parametrize(
    "seed", [3, np.random.Generator(np.random.Philox(3)), np.random.Generator(np.random.MT19937(3))]
)
def test_a_filter_goes_on_from_its_state_bit_for_bit(seed):
    settings = ParticleFilterSettings(resampler="stratified")
    particles = ParticleFilter.from_prior(PRIOR, 200, seed, settings)
    drive(particles, 2)
    state = particles.state()
    expected = drive(particles)
    particles.restore(state)
    for resumed in (particles, ParticleFilter.from_state(state, settings)):
        for one, other in zip(drive(resumed), expected, strict=True):
            np.testing.assert_array_equal(one, other)


def test_a_key_decides_all_further_randomness():
    state = ParticleFilter.from_prior(PRIOR, 200, 0).state()
    runs = []
    for before, key in ((1, 7), (2, 7), (2, 8)):
        particles = ParticleFilter.from_state(
            replace(state, generator=ParticleFilter([[0, 0, 0]], before).state().generator)
        )
        particles.reseed(key)
        runs.append(drive(particles)[0])
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[1], runs[2])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"particles": np.full((3, 3), np.nan)}, r"particles: expected finite values"),
        ({"log_weights": np.zeros(2)}, r"log weights: expected \(3,\), got \(2,\)"),
        ({"particles": np.empty((0, 3)), "log_weights": np.empty(0)}, r"filter state: expected particles"),
        ({"lost_score": 2.0}, r"filter state: expected particles and finite numbers"),
        ({"log_evidence": np.nan}, r"filter state: expected particles and finite numbers"),
        ({"generator": "{}"}, r"filter state: expected the state of a random generator"),
        ({"generator": "no JSON"}, r"filter state: expected the state of a random generator"),
    ],
)
def test_a_broken_state_is_refused_and_the_filter_stays(change, message):
    particles = ParticleFilter([[0, 0, 0], [1, 0, 0], [2, 0, 0]], 0)
    state = particles.state()
    with pytest.raises(SkyfixError, match=message):
        particles.restore(replace(state, **change))
    np.testing.assert_array_equal(particles.particles, state.particles)
    assert particles.state().generator == state.generator
