"""Looks: factors that a round would hardly change are left alone, all others are found anew, the answer stays."""

from typing import ClassVar

import numpy as np
import pytest

import fusion.graph.looks
from fusion import (
    GaussianMixture,
    MapGrid,
    OdometryIncrement,
    SmootherSettings,
    Trajectory,
    UniformPrior,
    se2,
    smooth,
)
from fusion.graph.looks import Looks
from fusion.graph.measurements import Measurements
from fusion.graph.patch import LikelihoodPatch
from fusion.likelihood import log_uniform_density

SEEN = np.diag([0.9, 0.6, 0.06]) ** 2
WINDOW = np.diag([0.5, 0.5, 0.04]) ** 2


class Counted(Measurements):
    """Remembers what it was asked for."""

    asked: ClassVar[list[int]] = []

    def some(self, places):
        self.asked.append(len(places))
        return super().some(places)


@pytest.fixture(autouse=True)
def _nothing_asked():
    Counted.asked.clear()


def gaussian(mean):
    return GaussianMixture(np.ones(1), np.array(mean)[None], SEEN[None])


def two_peaks(mean):
    """A patch of two streets 3 m apart."""
    mixture = GaussianMixture(
        np.array([0.5, 0.5]), np.array([mean, mean + np.array([0.0, 3.0, 0.0])]), np.array([SEEN] * 2)
    )
    grid = MapGrid(40, 40, 0.5, *(np.array(mean[:2]) - 10.0).tolist())
    x, y = grid.centres()
    yaw = np.deg2rad(np.arange(-20.0, 21.0, 2.0)) + mean[2]
    poses = np.stack(np.meshgrid(y, x, yaw, indexing="ij"), axis=-1)[..., [1, 0, 2]]
    values = np.maximum(mixture.log_density(poses.reshape(-1, 3)), -40.0).reshape(poses.shape[:3])
    return LikelihoodPatch(values.astype(np.float32), grid, -10, 180, -40.0, log_uniform_density(grid))


def at(count, seed=0):
    return np.random.default_rng(seed).normal(0.0, [0.5, 0.5, 0.03], (count, 3))


def windows(count):
    return np.repeat(WINDOW[None], count, axis=0)


def test_gaussians_are_looked_at_twice_and_others_until_they_stay():
    """Mixed kinds: what is asked for in a third round under cavities that have moved a little."""
    centres, zero = at(6), np.zeros(3)
    seen = Counted([two_peaks(zero), *[gaussian(zero)] * 4, two_peaks(zero)], 0.0, -9.2)
    looks = Looks(seen, centres)
    looks.renew(centres, windows(6))
    looks.renew(centres + 0.2 * WINDOW.diagonal() ** 0.5, windows(6))
    assert Counted.asked == [6, 6]
    before = looks.sites
    looks.renew(centres + 0.3 * WINDOW.diagonal() ** 0.5, windows(6))
    assert Counted.asked == [6, 6, 2]
    changed = np.abs(looks.sites.precision - before.precision).max(axis=(1, 2)) > 0.0
    np.testing.assert_array_equal(changed, [False] * 4 + [True] * 2)  # mixtures come first
    looks.renew(centres + 1.0 * WINDOW.diagonal() ** 0.5, windows(6))
    assert Counted.asked[3:] == [6]  # too far for a forecast


def test_a_cavity_that_changes_its_shape_has_moved():
    centres = at(3)
    seen = Counted([gaussian(np.zeros(3))] * 3, 0.0, -9.2)
    looks = Looks(seen, centres)
    for scale in (1.0, 0.9, 0.9 * 1.49, 0.9 * 1.6):
        looks.renew(centres, scale * windows(3))
    assert Counted.asked == [3, 3, 3]


def test_a_factor_on_its_way_is_looked_at_again_where_its_cavity_stays():
    """A look goes only most of the way to the new factor, which is nothing to a Gaussian's and much to another's."""
    centres = at(2)
    seen = Counted([two_peaks(np.zeros(3)), gaussian(np.zeros(3))], 0.0, -9.2)
    looks = Looks(seen, centres)
    for share in (0.0, 3.0, 3.0):
        looks.renew(centres + share * WINDOW.diagonal() ** 0.5, windows(2))
    assert Counted.asked == [2, 2, 1]


def test_what_is_left_alone_would_not_have_changed_the_answer(monkeypatch):
    """A drive with whole likelihoods of two peaks, smoothed with and without leaving factors alone."""
    rng, count = np.random.default_rng(3), 40
    noise, step = np.diag([0.2, 0.15, 0.02]) ** 2, np.array([2.0, 0.0, 0.03])
    truth, increments = [np.array([0.0, 0.0, 0.4])], []
    for k in range(1, count):
        truth.append(se2.compose(truth[-1], step))
        increments.append(OdometryIncrement(k, step + rng.multivariate_normal(np.zeros(3), noise), noise))
    measurements = [two_peaks(pose + rng.multivariate_normal(np.zeros(3), SEEN)) for pose in truth]
    start = Trajectory(
        np.arange(count),
        np.array(truth) + [0.5, -0.5, 0.03],
        np.repeat((np.diag([1.0, 1.0, 0.1]) ** 2)[None], count, 0),
    )
    prior = UniformPrior(truth[0], 5.0, 0.3)
    settings = SmootherSettings(odometry_kernel="none", max_iterations=40)
    monkeypatch.setattr("fusion.factor_graph.Measurements", Counted)
    found = smooth(start.stamp_ns, increments, measurements, prior, start, settings)
    spared = sum(Counted.asked)
    Counted.asked.clear()
    monkeypatch.setattr(fusion.graph.looks, "_TOLERANCE", -1.0)
    whole = smooth(start.stamp_ns, increments, measurements, prior, start, settings)
    assert found.converged
    assert whole.converged
    assert spared < 0.8 * sum(Counted.asked)
    off = se2.between(whole.trajectory.poses, found.trajectory.poses)
    assert np.abs(off[:, :2]).max() < 2e-3
    assert np.abs(off[:, 2]).max() < 2e-4
    np.testing.assert_allclose(found.trajectory.covariances, whole.trajectory.covariances, rtol=0.01, atol=1e-5)
    assert abs(found.log_evidence - whole.log_evidence) < 0.01
    np.testing.assert_array_equal(found.chosen, whole.chosen)


def test_evidence_is_that_of_a_look_at_everything():
    """Of cavities near those of the last looks, where the moments agree: to second order in the distance."""
    centres = at(4)
    seen = Measurements([two_peaks(np.zeros(3))] * 4, 0.02, -9.2)
    looks = Looks(seen, centres)
    for _ in range(12):
        looks.renew(centres, windows(4))
    there = looks.log_evidence()
    errors = []
    for share in (0.1, 0.05):
        moved = Looks(seen, centres)
        moved.sites = looks.sites
        moved.look(centres + share * WINDOW.diagonal() ** 0.5, windows(4))
        errors.append(abs(moved.log_evidence() - there))
    assert errors[0] < 0.02
    assert errors[1] < 0.35 * errors[0]
