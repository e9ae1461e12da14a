"""Simulated scans against closed forms: rings on flat ground, walls at known distances, occlusion, statistics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from sequences.lidar import LidarModel, hdl64_elevations_deg, simulate_scan
from sequences.world_model import DENSITY_STEP_PER_M, HEIGHT_STEP_M, Material, World

EXACT = LidarModel(
    azimuths=720,
    range_noise_m=0.0,
    beam_bias_m=0.0,
    drop_out=0.0,
    glass_share=0.0,
    tilt_noise_deg=0.0,
    max_range_m=60.0,
)
GRID = MapGrid(600, 640, 0.2, -64.0, -60.0)


def flat(grid: MapGrid = GRID) -> World:
    shape = (grid.rows, grid.cols)
    ground = np.zeros(shape, dtype=np.float32)
    layers = [np.zeros(shape, dtype=np.uint8) for _ in range(4)]
    return World(grid, ground, ground.copy(), *layers)


def stand(world: World, x: tuple[float, float], y: tuple[float, float], height: float) -> None:
    """Put a solid box onto a world."""
    xs, ys = world.grid.centres()
    inside = ((ys > y[0]) & (ys < y[1]))[:, None] & ((xs > x[0]) & (xs < x[1]))[None, :]
    world.surface[inside] = world.ground[inside] + height
    world.material[inside] = Material.WALL


def spread_slab(world: World, x: tuple[float, float], bottom: float, top: float, density: float) -> None:
    """Put a porous slab across a world between two values of x."""
    xs, _ = world.grid.centres()
    inside = np.broadcast_to((xs > x[0]) & (xs < x[1]), world.ground.shape)
    world.canopy_bottom[inside] = round(bottom / HEIGHT_STEP_M)
    world.canopy_top[inside] = round(top / HEIGHT_STEP_M)
    world.canopy_density[inside] = round(density / DENSITY_STEP_PER_M)


def to_map(points: NDArray[np.float32], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return points[:, :2].astype(np.float64) @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]


def test_flat_ground_gives_rings_of_known_radius() -> None:
    points = simulate_scan(flat(), np.array([0.0, 0.0, 0.3]), EXACT, 0)
    radius = np.hypot(points[:, 0], points[:, 1])
    expected = EXACT.mount_height_m / np.tan(-np.deg2rad(hdl64_elevations_deg()))
    expected = expected[(expected > EXACT.min_range_m) & (expected < EXACT.max_range_m)]
    assert np.abs(radius[:, None] - expected).min(axis=1).max() < 1e-3
    assert np.abs(points[:, 2] + EXACT.mount_height_m).max() < 1e-4
    assert len(points) == len(expected) * EXACT.azimuths


@pytest.mark.parametrize("yaw", [0.0, 0.5 * np.pi, -2.0, 3.0])
@pytest.mark.parametrize("side", ["east", "north", "west", "south"])
def test_wall_is_seen_at_its_distance_on_its_side(side: str, yaw: float) -> None:
    """One wall on one side: catches every swapped axis and sign."""
    world, wall = flat(), 12.0
    x, y = {
        "east": ((wall, wall + 1.0), (-40.0, 40.0)),
        "west": ((-wall - 1.0, -wall), (-40.0, 40.0)),
        "north": ((-40.0, 40.0), (wall, wall + 1.0)),
        "south": ((-40.0, 40.0), (-wall - 1.0, -wall)),
    }[side]
    stand(world, x, y, 5.0)
    pose = np.array([0.03, -0.07, yaw])
    points = simulate_scan(world, pose, EXACT, 0)
    high = to_map(points[points[:, 2] > 0.2 - EXACT.mount_height_m], pose)
    assert len(high) > 500
    across, along, sign = (0, 1, 1.0) if side == "east" else (0, 1, -1.0) if side == "west" else (1, 0, 1.0)
    sign = -1.0 if side == "south" else sign
    assert np.abs(high[:, across] * sign - wall).max() < 1e-3
    assert np.ptp(high[:, along]) > 40.0


def test_nothing_is_seen_behind_a_tall_wall() -> None:
    world = flat()
    stand(world, (10.0, 11.0), (-59.0, 59.0), 6.0)
    stand(world, (20.0, 30.0), (-59.0, 59.0), 20.0)
    pose = np.zeros(3)
    points = to_map(simulate_scan(world, pose, EXACT, 0), pose)
    assert points[:, 0].max() < 10.01
    assert points[:, 0].min() < -40.0


def test_low_wall_hides_the_ground_behind_it_and_not_the_house() -> None:
    world = flat()
    stand(world, (10.0, 10.4), (-59.0, 59.0), 1.0)
    stand(world, (20.0, 30.0), (-59.0, 59.0), 20.0)
    points = simulate_scan(world, np.zeros(3), EXACT, 0)
    ahead = points[np.abs(points[:, 1]) < 2.0]
    # the ray over the wall's far edge meets the ground at h / (h - 1) * 10.4 m > 20 m
    ground_behind = (ahead[:, 0] > 10.5) & (ahead[:, 2] < 0.1 - EXACT.mount_height_m)
    assert not ground_behind.any()
    house = ahead[ahead[:, 0] > 19.0]
    assert house[:, 0] == pytest.approx(20.0, abs=1e-3)
    lowest = EXACT.mount_height_m * (1 - 20.0 / 10.4) + 20.0 / 10.4 * 1.0
    assert house[:, 2].min() + EXACT.mount_height_m > lowest - 0.05


def test_sloping_ground_is_flat_for_a_vehicle_that_stands_on_it() -> None:
    world = flat()
    x, _ = world.grid.centres()
    world.ground[:] = (0.05 * x).astype(np.float32)
    world.surface[:] = world.ground
    points = simulate_scan(world, np.array([1.0, 2.0, 0.7]), EXACT, 0)
    near = np.hypot(points[:, 0], points[:, 1]) < 15.0
    assert np.abs(points[near, 2] + EXACT.mount_height_m).max() < 0.08


def test_tilted_sensor_turns_what_it_sees() -> None:
    tilted = replace(EXACT, mount_pitch_deg=2.0)
    points = simulate_scan(flat(), np.zeros(3), tilted, 0)
    ahead = points[(np.abs(points[:, 1]) < 1.0) & (points[:, 0] > 8.0) & (points[:, 0] < 20.0)]
    # nose up by 2 degrees: the ground ahead falls away in the sensor frame
    slope = np.polyfit(ahead[:, 0], ahead[:, 2], 1)[0]
    assert slope == pytest.approx(-np.tan(np.deg2rad(2.0)), abs=2e-3)


def test_porous_slab_lets_the_known_share_through() -> None:
    """Beams near the horizon cross 1 m of foliage of density d: a share exp(-d) goes on."""
    density = 0.7
    world = flat()
    spread_slab(world, (8.0, 9.0), 0.0, 4.0, density)
    stand(world, (20.0, 21.0), (-59.0, 59.0), 20.0)
    model = replace(EXACT, elevations_deg=tuple(np.linspace(-1.0, 1.0, 40)), azimuths=2000)
    points = simulate_scan(world, np.zeros(3), model, 3)
    ahead = points[(points[:, 0] > 0.0) & (np.abs(np.arctan2(points[:, 1], points[:, 0])) < 0.1)]
    passed = np.mean(ahead[:, 0] > 10.0)
    deviation = np.sqrt(np.exp(-density) * (1.0 - np.exp(-density)) / len(ahead))
    assert passed == pytest.approx(np.exp(-density), abs=5.0 * deviation)
    inside = ahead[ahead[:, 0] < 10.0]
    assert inside[:, 0].min() > 7.99
    assert inside[:, 0].max() < 9.01


def test_beams_pass_under_a_crown() -> None:
    world = flat()
    spread_slab(world, (8.0, 14.0), 2.5, 6.0, 12.0)
    stand(world, (20.0, 21.0), (-59.0, 59.0), 20.0)
    points = simulate_scan(world, np.zeros(3), EXACT, 0)
    ahead = points[np.abs(points[:, 1]) < 1.0]
    low = ahead[ahead[:, 2] > 0.1 - EXACT.mount_height_m]
    assert np.any(low[:, 0] > 19.9)
    in_crown = (ahead[:, 0] > 7.9) & (ahead[:, 0] < 14.1) & (ahead[:, 2] > 0.1 - EXACT.mount_height_m)
    assert not in_crown.any()  # +2 degrees reach 2.2 m at 14 m


def test_noise_and_drop_out_have_the_stated_size() -> None:
    world = flat()
    stand(world, (10.0, 11.0), (-59.0, 59.0), 20.0)
    model = replace(EXACT, range_noise_m=0.05, elevations_deg=(0.0,), azimuths=4000)
    points = simulate_scan(world, np.zeros(3), model, 1)
    ahead = points[(points[:, 0] > 0.0) & (np.abs(points[:, 1]) < 1.0)]
    residual = np.hypot(ahead[:, 0], ahead[:, 1]) - 10.0 / np.cos(np.arctan2(ahead[:, 1], ahead[:, 0]))
    assert len(residual) > 100
    assert residual.std() == pytest.approx(0.05, rel=0.25)
    assert abs(residual.mean()) < 0.02
    everything = len(simulate_scan(flat(), np.zeros(3), EXACT, 1))
    kept = len(simulate_scan(flat(), np.zeros(3), replace(EXACT, drop_out=0.3), 1))
    assert kept / everything == pytest.approx(0.7, abs=0.02)


def test_same_seed_same_scan_and_other_seed_another() -> None:
    world = flat()
    spread_slab(world, (8.0, 12.0), 0.0, 3.0, 0.5)
    pose = np.array([1.0, 2.0, 0.4])
    one, same, other = (simulate_scan(world, pose, LidarModel(), seed) for seed in (7, 7, 8))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)


def test_vehicle_hides_what_is_low_behind_it() -> None:
    model = replace(EXACT, rear_shadow_deg=-15.0)
    points = simulate_scan(flat(), np.zeros(3), model, 0)
    elevation = np.rad2deg(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    behind = np.abs(np.arctan2(points[:, 1], points[:, 0])) > np.deg2rad(159.0)
    assert elevation[behind].min() > -15.0
    assert elevation[~behind].min() < -24.0


def test_scan_at_the_border_sees_only_the_world() -> None:
    pose = np.array([GRID.x0 + 0.5, GRID.y0 + 0.5, 0.0])
    points = simulate_scan(flat(), pose, EXACT, 0)
    assert GRID.contains(to_map(points, pose)).all()
    assert np.isfinite(points).all()
    assert points.dtype == np.float32


@pytest.mark.parametrize("pose", [[np.nan, 0.0, 0.0], [0.0, 0.0, np.inf], [1e4, 0.0, 0.0], [0.0, 0.0]])
def test_unusable_pose_is_refused(pose: list[float]) -> None:
    with pytest.raises(SkyfixError, match="lidar: expected a"):
        simulate_scan(flat(), np.array(pose), EXACT, 0)


@pytest.mark.parametrize(
    "change", [{"elevations_deg": ()}, {"elevations_deg": (89.0,)}, {"azimuths": 0}, {"max_range_m": 1.0}]
)
def test_unusable_sensor_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(SkyfixError, match="lidar: expected"):
        replace(EXACT, **change)


def test_random_sensors_are_usable_and_repeatable() -> None:
    for seed in range(20):
        model = LidarModel.random(np.random.default_rng(seed))
        assert model == LidarModel.random(np.random.default_rng(seed))
        assert 1.3 < model.mount_height_m < 2.3
