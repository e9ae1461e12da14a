"""Odometries of bodies and of cameras, in frames of any orientation, move a vehicle alike."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fusion import se2
from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from sequences.folder import FolderSequence
from sequences.odometry_axes import on_the_ground, planar
from sequences.odometry_formats import read_odometry
from sequences.trajectory_io import read_tum

CAMERA = Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]])  # forward, left, up -> right, down, forward


def drive(steps: int = 200) -> tuple[FloatArray, Rotation]:
    """A bend and a hill: positions and body-to-world rotations, z up."""
    way = np.linspace(0.0, 150.0, steps)
    yaw, pitch = 0.8 * np.sin(way / 40.0), 0.03 * np.cos(way / 25.0)
    rotations = Rotation.from_euler("zyx", np.stack([yaw, pitch, 0.01 * np.sin(way / 9.0)], axis=1))
    steps_m = rotations[:-1].apply(np.tile([way[1], 0.0, 0.0], (steps - 1, 1)))
    return np.vstack([np.zeros(3), np.cumsum(steps_m, axis=0)]), rotations


POSITIONS, ROTATIONS = drive()
EXPECTED = on_the_ground(POSITIONS, ROTATIONS)


def increments(poses: FloatArray) -> FloatArray:
    return np.asarray(se2.between(poses[:-1], poses[1:]))


def write(path: Path, positions: FloatArray, rotations: Rotation) -> Path:
    lines = [
        " ".join(f"{value:.12f}" for value in (0.1 * k, *position, *quaternion))
        for k, (position, quaternion) in enumerate(zip(positions, rotations.as_quat(), strict=True))
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_body_in_an_upright_frame_is_read_as_it_is(tmp_path: Path) -> None:
    file = write(tmp_path / "wheels.tum", POSITIONS, ROTATIONS)
    np.testing.assert_array_equal(read_odometry(file, "wheels").poses, read_tum(file).poses)
    np.testing.assert_allclose(read_tum(file).poses, EXPECTED, atol=1e-9)
    assert read_odometry(file, "wheels").frame_id == "wheels"


def test_a_camera_in_a_camera_s_frame_moves_the_vehicle_alike(tmp_path: Path) -> None:
    """As ORB-SLAM, DSO or KITTI's own poses give it: the first pose is the identity, y points down."""
    file = write(tmp_path / "orb.tum", CAMERA.apply(POSITIONS), CAMERA * ROTATIONS * CAMERA.inv())
    assert read_tum(file).poses[-1, 1] ** 2 < 100.0  # read as a body's the way ahead is lost
    poses = read_odometry(file, "orb").poses
    np.testing.assert_allclose(increments(poses)[:, :2], increments(EXPECTED)[:, :2], atol=1e-3)
    np.testing.assert_allclose(se2.wrap(increments(poses)[:, 2] - increments(EXPECTED)[:, 2]), 0.0, atol=1e-4)


@settings(deadline=None, max_examples=40)
@given(st.tuples(*[st.floats(-1.0, 1.0)] * 4), st.booleans())
def test_no_orientation_of_the_frame_matters(quaternion: tuple[float, float, float, float], camera: bool) -> None:
    if np.linalg.norm(quaternion) < 0.1:
        return
    world = Rotation.from_quat(quaternion)
    rotations = world * ROTATIONS * CAMERA.inv() if camera else world * ROTATIONS
    moved = increments(planar(world.apply(POSITIONS) + [5.0, -3.0, 8.0], rotations, "any"))
    tilt = 0.6  # a frame within 30 degrees of upright is kept as it is, and its tilt is taken for the ground's
    length = np.hypot(*moved[:, :2].T) / np.hypot(*increments(EXPECTED)[:, :2].T)
    assert np.cos(tilt) < length.min() <= length.max() < 1.0 + 1e-2
    if world.apply([0.0, 0.0, 1.0])[2] < np.cos(np.deg2rad(33.0)):
        np.testing.assert_allclose(moved[:, :2], increments(EXPECTED)[:, :2], atol=0.01)
        np.testing.assert_allclose(se2.wrap(moved[:, 2] - increments(EXPECTED)[:, 2]), 0.0, atol=2e-3)


@pytest.mark.parametrize("reverses", [False, True])
def test_a_vehicle_that_reverses_or_stands_is_still_a_body(reverses: bool) -> None:
    positions = -POSITIONS if reverses else 0.001 * POSITIONS
    rotations = Rotation.from_euler("z", np.pi * reverses) * ROTATIONS
    np.testing.assert_array_equal(planar(positions, rotations, "w"), on_the_ground(positions, rotations))


@pytest.mark.parametrize(
    ("axes", "moves"),
    [
        ([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], "-y"),  # forward is -y
        ([[0, -1, 0], [1, 0, 0], [0, 0, 1]], "y"),  # right, forward, up
        ([[0, -1, 0], [0, 0, 1], [-1, 0, 0]], "-z"),  # OpenGL's camera: right, up, backward
    ],
)
def test_other_axes_are_refused_by_name(axes: list[list[int]], moves: str) -> None:
    body = Rotation.from_matrix(axes)
    with pytest.raises(SkyfixError, match=f"odometry vo: expected a body that looks along x .* moves along {moves}$"):
        planar(POSITIONS, ROTATIONS * body.inv(), "vo")


def test_real_odometry_turned_into_a_camera_s_is_read_back(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    poses = FolderSequence(shared_data("kitti00")).odometry("sptam").poses
    positions = np.column_stack([poses[:, :2], np.zeros(len(poses))])
    rotations = Rotation.from_euler("z", poses[:, 2:])
    file = write(tmp_path / "sptam.tum", CAMERA.apply(positions), CAMERA * rotations * CAMERA.inv())
    np.testing.assert_allclose(increments(read_odometry(file, "sptam").poses), increments(poses), atol=1e-7)
