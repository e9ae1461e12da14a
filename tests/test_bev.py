"""Bird's-eye views: axes, bands, sloping ground, bad scans."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.errors import SkyfixError
from learned.bev import BODY, GROUND, HIGH, BevSettings, bev_counts, ground_surface, log_density

SETTINGS = BevSettings(half_extent_m=20.0)


def ground_points(grade: float = 0.0, z: float = -1.7, seed: int = 0, n: int = 60_000) -> np.ndarray:
    xy = np.random.default_rng(seed).uniform(-20, 20, (n, 2))
    return np.column_stack([xy, z + grade * xy[:, 0], np.zeros(n)]).astype(np.float32)


@given(ahead=st.floats(2.1, 19), left=st.floats(-19, 19))
def test_a_pole_is_counted_in_its_cell(ahead: float, left: float) -> None:
    pole = np.array([[ahead, left, -1.7 + h, 0.0] for h in (1.2, 1.4, 2.5)], dtype=np.float32)
    counts = bev_counts(np.concatenate([ground_points(), pole]), -1.7, SETTINGS)
    row, col = math.floor((20 - pole[0, 1]) / 0.5), math.floor((20 + pole[0, 0]) / 0.5)
    assert counts[BODY].sum() == 2
    assert counts[HIGH].sum() == 1
    assert counts[BODY, row, col] == 2
    assert counts[HIGH, row, col] == 1


@pytest.mark.parametrize("grade", [-0.1, 0.0, 0.1])
def test_a_slope_is_ground_and_not_a_wall(grade: float) -> None:
    points = ground_points(grade)
    counts = bev_counts(points, -1.7, SETTINGS)
    assert counts[GROUND].sum() > 0.98 * len(points)
    assert counts[1:].sum() == 0


def test_above_a_plane_a_slope_is_a_wall_and_flat_ground_is_ground() -> None:
    plane = BevSettings(half_extent_m=20.0, ground="plane")
    flat, slope = (bev_counts(ground_points(grade), -1.7, plane) for grade in (0.0, 0.1))
    assert flat[GROUND].sum() == 60_000
    assert flat[1:].sum() == 0
    ahead = slope[:, :, 60:].sum(axis=(1, 2))  # from 10 m ahead, where the ground is 1 to 2 m above the foot
    assert ahead[BODY] == ahead.sum() == pytest.approx(15_000, rel=0.05)


def test_an_unknown_ground_is_refused() -> None:
    with pytest.raises(SkyfixError, match="expected a ground of surface or plane, got 'mesh'"):
        BevSettings(ground="mesh")


def test_the_ground_passes_under_a_building() -> None:
    """Roof returns 6 m up, with no ground seen beneath, lift the ground by no more than its largest slope."""
    points = ground_points()
    inside = (points[:, 0] > 8) & (points[:, 0] < 14) & (np.abs(points[:, 1]) < 3)
    points[inside, 2] += 6.0
    surface = ground_surface(points, -1.7, 20.0)
    assert surface.max() < -1.7 + 0.15 * 3.5 + 0.05
    assert bev_counts(points, -1.7, SETTINGS)[3].sum() > 0.9 * inside.sum()


def test_density_is_bounded_and_monotone() -> None:
    density = log_density(np.array([0.0, 1.0, 5.0, 1e6], dtype=np.float32))
    assert density[0] == 0.0
    assert density[-1] == 1.0
    assert (np.diff(density) > 0).all()


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((0, 4), np.float32), "at least one point"),
        (np.zeros((5, 2), np.float32), r"expected \(N, 4\)"),
        (np.full((5, 4), np.nan, np.float32), "5 of 5 points"),
    ],
)
def test_bad_scans_are_named(points: np.ndarray, message: str) -> None:
    with pytest.raises(SkyfixError, match=message):
        bev_counts(points, -1.7, SETTINGS)
