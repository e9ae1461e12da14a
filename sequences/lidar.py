"""Scans of a spinning LiDAR in a 2.5-D world.

The sensor stands on the terrain as its vehicle's wheels do, with some tilt of its own; beams are cast by
`sequences.lidar_kernel`; range noise, drop-out by material and the vehicle's own shadow are added here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.errors import SkyfixError
from sequences.lidar_kernel import cast
from sequences.world_model import World

_WHEEL_BASE_M, _TRACK_M = 2.7, 1.6
_REFLECTANCE = np.array([0.25, 0.2, 0.4, 0.35, 0.3, 0.35, 0.35, 0.5, 0.3, 0.05], dtype=np.float32)
_DROP_OUT = np.array([0.0, 0.02, 0.06, 0.02, 0.03, 0.02, 0.12, 0.03, 0.02, 0.8], dtype=np.float32)


def hdl64_elevations_deg() -> NDArray[np.floating]:
    """Elevations (64,) of an HDL-64E: 32 beams from +2 by 1/3 degree, 32 from -8.83 to -24.8 by about 1/2 degree."""
    return np.concatenate([2.0 - np.arange(32) * (10.33 / 31.0), -8.83 - np.arange(32) * (15.97 / 31.0)])


def hdl32_elevations_deg() -> NDArray[np.floating]:
    """Elevations (32,) of an HDL-32E: +10.67 to -30.67 by 4/3 degree."""
    return 10.67 - np.arange(32) * (41.34 / 31.0)


@dataclass(frozen=True, slots=True)
class LidarModel:
    """A spinning LiDAR on a car.

    Attributes
    ----------
    elevations_deg
        Beam elevations above the sensor's horizon, degrees.
    azimuths
        Beams of one elevation per revolution.
    min_range_m, max_range_m
        Horizontal distances outside which nothing is returned.
    range_noise_m, beam_bias_m
        Standard deviations of the noise of each return and of each beam's constant error.
    drop_out
        Share of returns lost at random, beside what each material swallows.
    glass_share
        Share of facade patches (about 1 x 1 m) that are glass and return nothing.
    mount_height_m
        Sensor above the ground.
    rear_shadow_deg, front_shadow_deg
        Beams lower than this elevation meet the vehicle itself within 22 degrees of straight back or 30 degrees of
        straight ahead.
    mount_pitch_deg, mount_roll_deg
        Constant tilt of the sensor against the vehicle: nose up, left side up.
    tilt_noise_deg
        Standard deviation of roll and pitch of each scan beside that and what the terrain makes of them.
    """

    elevations_deg: tuple[float, ...] = tuple(hdl64_elevations_deg())
    azimuths: int = 1000
    min_range_m: float = 2.0
    max_range_m: float = 85.0
    range_noise_m: float = 0.02
    beam_bias_m: float = 0.015
    drop_out: float = 0.03
    glass_share: float = 0.12
    mount_height_m: float = 1.73
    rear_shadow_deg: float = -90.0
    front_shadow_deg: float = -90.0
    mount_pitch_deg: float = 0.0
    mount_roll_deg: float = 0.0
    tilt_noise_deg: float = 0.4

    def __post_init__(self) -> None:
        if not self.elevations_deg or max(abs(e) for e in self.elevations_deg) >= 80.0:
            raise SkyfixError("lidar: expected beam elevations within +-80 degrees, got none or steeper ones")
        if self.azimuths < 4 or not 0.0 < self.min_range_m < self.max_range_m:
            raise SkyfixError(
                "lidar: expected at least 4 azimuths and 0 < min_range_m < max_range_m, "
                f"got {self.azimuths}, {self.min_range_m}, {self.max_range_m}"
            )

    @classmethod
    def random(cls, rng: np.random.Generator, azimuths: int = 1000) -> LidarModel:
        """Draw a sensor: mostly HDL-64 with small errors, sometimes 32 beams or an even fan, at varying heights."""
        kind = rng.random()
        if kind < 0.7:
            elevations = hdl64_elevations_deg()
        elif kind < 0.85:
            elevations = hdl32_elevations_deg()
        else:
            elevations = np.linspace(rng.uniform(2.0, 15.0), rng.uniform(-25.0, -15.0), int(rng.integers(32, 129)))
        return cls(
            tuple(float(e) for e in elevations + rng.uniform(0.0, 1.2) + rng.normal(0.0, 0.03, len(elevations))),
            azimuths,
            min_range_m=float(rng.uniform(1.3, 3.0)),
            max_range_m=float(rng.uniform(70.0, 100.0)),
            range_noise_m=float(rng.uniform(0.01, 0.04)),
            beam_bias_m=float(rng.uniform(0.0, 0.03)),
            drop_out=float(rng.uniform(0.0, 0.06)),
            glass_share=float(rng.uniform(0.0, 0.25)),
            mount_height_m=float(rng.normal(1.7, 0.08)) if kind < 0.7 else float(rng.uniform(1.6, 2.1)),
            rear_shadow_deg=float(rng.uniform(-25.0, -12.0)),
            front_shadow_deg=float(rng.uniform(-30.0, -18.0)),
            mount_pitch_deg=float(rng.normal(-0.4, 0.4)),
            mount_roll_deg=float(rng.normal(0.0, 1.2)),
            tilt_noise_deg=float(rng.uniform(0.1, 0.8)),
        )


def simulate_scan(
    world: World, pose: NDArray[np.float64], model: LidarModel, rng: np.random.Generator | int
) -> NDArray[np.float32]:
    """Cast one revolution of beams.

    Parameters
    ----------
    world
        What there is to hit; beams that leave it return nothing.
    pose
        Vehicle pose (3,), map frame.
    model
        The sensor.
    rng
        Generator or seed of noise, drop-out and foliage; same state, same scan.

    Returns
    -------
    points
        (N, 4) float32: x forward, y left, z up of the sensor, metres, and reflectance in [0, 1]. The ground under
        the vehicle is at z = -mount height; the frame pitches and rolls with the vehicle.

    Raises
    ------
    SkyfixError
        If the pose is not finite or outside the world.
    """
    pose = np.asarray(pose, dtype=np.float64)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise SkyfixError(f"lidar: expected a finite pose (3,), got {pose.tolist()}")
    if not bool(world.grid.contains(pose[:2])):
        raise SkyfixError(f"lidar: expected a pose inside the world, got ({pose[0]:.1f}, {pose[1]:.1f})")
    rng = np.random.default_rng(rng)
    height, pitch, roll = _attitude(world, pose)
    mount = np.array([model.mount_pitch_deg, model.mount_roll_deg])
    pitch, roll = np.array([pitch, roll]) + np.deg2rad(mount + model.tilt_noise_deg * rng.standard_normal(2))
    elevations = np.sort(np.deg2rad(np.array(model.elevations_deg)))
    bias = model.beam_bias_m * rng.standard_normal(len(elevations))
    azimuths = (np.arange(model.azimuths) + rng.random()) * (2.0 * np.pi / model.azimuths)
    start = world.grid.pixel_from_xy(pose[:2])
    distance, kind = cast(
        world.surface,
        world.ground,
        world.canopy_bottom,
        world.canopy_top,
        world.canopy_density,
        world.material,
        start[0],
        start[1],
        world.grid.metres_per_pixel,
        height + model.mount_height_m,
        pose[2] + azimuths,
        np.tan(elevations),
        np.tan(pitch) * np.cos(azimuths) + np.tan(roll) * np.sin(azimuths),
        model.min_range_m,
        model.max_range_m,
        model.glass_share,
        np.uint32(rng.integers(0, 2**32, dtype=np.uint64)),
    )
    hit_azimuth, hit_beam = np.nonzero((distance > 0.0) & ~_ego_shadow(model, azimuths, elevations))
    hit_kind = kind[hit_azimuth, hit_beam]
    kept = rng.random(len(hit_kind)) >= 1.0 - (1.0 - model.drop_out) * (1.0 - _DROP_OUT[hit_kind])
    hit_azimuth, hit_beam, hit_kind = hit_azimuth[kept], hit_beam[kept], hit_kind[kept]
    along = distance[hit_azimuth, hit_beam]
    noise = bias[hit_beam] + model.range_noise_m * rng.standard_normal(len(along))
    tilt = np.tan(pitch) * np.cos(azimuths) + np.tan(roll) * np.sin(azimuths)
    in_world = np.arctan(np.tan(elevations)[hit_beam] + tilt[hit_azimuth])
    reach = along / np.cos(in_world) + noise
    flat = reach * np.cos(elevations)[hit_beam]
    reflectance = np.clip(_REFLECTANCE[hit_kind] + 0.1 * rng.standard_normal(len(along)), 0.0, 1.0)
    points = np.empty((len(along), 4), dtype=np.float32)
    points[:, 0] = flat * np.cos(azimuths)[hit_azimuth]
    points[:, 1] = flat * np.sin(azimuths)[hit_azimuth]
    points[:, 2] = reach * np.sin(elevations)[hit_beam]
    points[:, 3] = reflectance
    return points


def _ego_shadow(
    model: LidarModel, azimuths: NDArray[np.floating], elevations: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """Which (azimuths, beams) the vehicle itself blocks."""
    lowest = np.full(len(azimuths), -np.pi)
    lowest[np.cos(azimuths) > np.cos(np.deg2rad(30.0))] = np.deg2rad(model.front_shadow_deg)
    lowest[np.cos(azimuths) < -np.cos(np.deg2rad(22.0))] = np.deg2rad(model.rear_shadow_deg)
    shadow: NDArray[np.bool_] = elevations[None, :] < lowest[:, None]
    return shadow


def _attitude(world: World, pose: NDArray[np.float64]) -> tuple[float, float, float]:
    """Height of the ground under the vehicle, pitch (nose up) and roll (left side up) that the terrain gives it."""
    forward = 0.5 * _WHEEL_BASE_M * np.array([np.cos(pose[2]), np.sin(pose[2])])
    left = 0.5 * _TRACK_M * np.array([-np.sin(pose[2]), np.cos(pose[2])])
    wheels = pose[:2] + np.array([forward + left, forward - left, -forward + left, -forward - left])
    front_left, front_right, rear_left, rear_right = world.ground_at(wheels)
    pitch = np.arctan(0.5 * (front_left + front_right - rear_left - rear_right) / _WHEEL_BASE_M)
    roll = np.arctan(0.5 * (front_left + rear_left - front_right - rear_right) / _TRACK_M)
    return 0.25 * (front_left + front_right + rear_left + rear_right), float(pitch), float(roll)
