"""An odometry's poses in space laid onto the ground, whichever way its axes point.

Here a body looks along x, has y on its left and z above, and so do LiDAR odometries and wheels (ROS, REP 103). A camera
looks along z, has x on its right and y below, and visual odometries give the poses of a camera, in a frame of a
camera's axes too. Which of the two a trajectory is shows in how it moves: a vehicle goes where it looks. Which way is
up in its frame is where the body's own upper side points on average.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError

_STEP_M = 0.05  # shorter ones are noise
_LEAST_WAY_M = 2.0
_DOMINANT = 3.0
"""A direction in which a body moves so many times as far as in each other one is where it looks."""
_UPRIGHT = np.cos(np.deg2rad(30.0))
_OF_CAMERA = Rotation.from_matrix(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
"""Turns vectors from forward, left, up to a camera's right, down, forward."""


def planar(positions: FloatArray, rotations: Rotation, name: str) -> FloatArray:
    """Poses (N, 3), x, y and yaw, in a frame whose z points up.

    A frame that has z within 30 degrees of up is kept; another one is turned the shortest way.

    Parameters
    ----------
    positions, rotations
        (N, 3) metres and N rotations, body to the odometry's frame.
    name
        Of the odometry, for errors.

    Raises
    ------
    SkyfixError
        If the body moves mostly along its y axis, or backwards along z, as nothing does that is known here.
    """
    way = _way(positions, rotations)
    along = int(np.argmax(np.abs(way)))
    others = np.delete(np.abs(way), along).max()
    if np.abs(way[along]) >= max(_LEAST_WAY_M, _DOMINANT * others) and along != 0:
        if along == 1 or way[2] < 0.0:
            direction = f"{'-' if way[along] < 0.0 else ''}{'xyz'[along]}"
            raise SkyfixError(
                f"odometry {name}: expected a body that looks along x (y left, z up) or a camera that looks along z "
                f"(x right, y down), got one that moves along {direction}"
            )
        rotations = rotations * _OF_CAMERA
    up = rotations.apply([0.0, 0.0, 1.0]).mean(axis=0)
    if up[2] < _UPRIGHT * np.linalg.norm(up):
        upright = _turning_up(up / np.linalg.norm(up))
        positions, rotations = upright.apply(positions), upright * rotations
    return on_the_ground(positions, rotations)


def on_the_ground(positions: FloatArray, rotations: Rotation) -> FloatArray:
    """Poses (N, 3), x, y and yaw, of positions (N, 3) and rotations of bodies that look along x; z is up."""
    forward = rotations.apply([1.0, 0.0, 0.0])
    return np.column_stack([positions[:, :2], np.arctan2(forward[:, 1], forward[:, 0])])


def _turning_up(up: FloatArray) -> Rotation:
    """The smallest rotation that turns a unit vector (3,) to z."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, up[2])
    return Rotation.from_rotvec(angle * (axis / sine if sine > 1e-12 else np.array([1.0, 0.0, 0.0])))


def _way(positions: FloatArray, rotations: Rotation) -> FloatArray:
    """How far (3,) the body has moved along each of its own axes, metres."""
    steps = np.diff(positions, axis=0)
    counts = np.linalg.norm(steps, axis=1) > _STEP_M
    if not counts.any():
        return np.zeros(3)
    return np.asarray(rotations[:-1][counts].inv().apply(steps[counts]).sum(axis=0))
