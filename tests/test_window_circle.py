"""Windows over likelihoods of the whole circle: the same at every heading, and the floor beyond the crop."""

import numpy as np
import pytest

from fusion import MapGrid, UniformPrior, smooth
from fusion.graph.likelihood_bank import LikelihoodBank
from fusion.graph.patch import patch_of
from fusion.likelihood import LikelihoodVolume
from fusion.odometry import OdometryIncrement
from fusion.trajectory import Trajectory

GRID = MapGrid(40, 40, 0.5, -10.0, -10.0)
BINS = 64
HEADINGS = 2.0 * np.pi * np.arange(BINS) / BINS
SIGMA = 0.3


def about(yaw: float) -> LikelihoodVolume:
    """Flat in position, a normal heading about `yaw`."""
    away = (HEADINGS - yaw + np.pi) % (2.0 * np.pi) - np.pi
    scores = np.broadcast_to(-0.5 * (away / SIGMA) ** 2, (GRID.rows, GRID.cols, BINS))
    return LikelihoodVolume.from_scores(scores.astype(np.float32), GRID)


@pytest.mark.parametrize("yaw", [0.0, 0.05, 1.5, np.pi, -3.1, 6.2])
@pytest.mark.parametrize("width", [0.25, 0.8, 2.0])
def test_a_wide_window_sees_both_sides_of_every_heading(yaw: float, width: float) -> None:
    """Against the integral over the heading, images a turn apart and all."""
    found = LikelihoodBank([patch_of(about(yaw))], 0.0).windowed(
        np.array([[0.0, 0.0, yaw]]), np.diag([1.0, 1.0, width**2])[None]
    )
    u = np.linspace(-5.0, 5.0, 100_001)
    away = (width * u + np.pi) % (2.0 * np.pi) - np.pi
    tilted = np.exp(-0.5 * (away / SIGMA) ** 2 - 0.5 * u**2)
    expected = (tilted * u**2).sum() / tilted.sum()
    assert abs(found.means[0, 2]) < 0.05 * np.sqrt(expected)  # a peak between two bins, and float32
    assert found.spreads[0, 2, 2] == pytest.approx(expected, rel=0.05)
    density = 1.0 / (np.sqrt(2.0 * np.pi) * SIGMA * GRID.area_m2)  # of the peak
    share = tilted.sum() / np.exp(-0.5 * u**2).sum()
    assert found.log_mass[0] == pytest.approx(np.log(density * share), abs=0.03)


@pytest.mark.parametrize("yaw", [0.0, np.pi])
def test_a_smoother_is_as_good_eastward_as_northward(yaw: float) -> None:
    """Two poses and wide priors: the headings' posterior does not depend on where the circle was cut."""
    stamps = np.array([0, 10**9])

    def smoothed(at: float) -> tuple[np.ndarray, float]:
        step = np.array([1.0, 0.0, 0.0])
        poses = np.array([[0.0, 0.0, at], [np.cos(at), np.sin(at), at]])
        wide = np.diag([0.5, 0.5, 0.8]) ** 2
        start = Trajectory(stamps, poses, np.repeat(np.diag([1.0, 1.0, 0.64])[None], 2, axis=0))
        motion = [OdometryIncrement(10**9, step, wide)]
        found = smooth(stamps, motion, [about(at)] * 2, UniformPrior(poses[0], 3.0, 1.0), start)
        away = (found.trajectory.poses[:, 2] - at + np.pi) % (2.0 * np.pi) - np.pi
        assert np.abs(away).max() < 0.03
        return np.sqrt(found.trajectory.covariances[:, 2, 2]), found.log_evidence

    (deviations, evidence), (expected, expected_evidence) = smoothed(yaw), smoothed(1.5)
    np.testing.assert_allclose(deviations, expected, rtol=0.05)
    assert evidence == pytest.approx(expected_evidence, abs=0.1)


def test_a_wide_window_far_from_the_crop_has_the_floor_and_moments() -> None:
    """Nothing but the floor is in reach: its density, and the window's own moments."""
    patch = patch_of(about(1.5))
    found = LikelihoodBank([patch], 0.0).windowed(np.array([[80.0, 0.0, 1.5]]), np.diag([9.0, 9.0, 0.04])[None])
    assert found.log_mass[0] == pytest.approx(patch.floor, abs=0.01)
    np.testing.assert_allclose(found.means[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(found.spreads[0], np.eye(3), atol=1e-9)
