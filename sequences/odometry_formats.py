"""Odometry as other programs write it: stamped poses of a body or of a camera, in a frame of their own.

    NAME.tum    t x y z qx qy qz qw, seconds: TUM's
    NAME.txt    the same, or twelve numbers: KITTI's 3 x 4 matrix row by row, a line a scan, whose stamps it has
    NAME.csv    EuRoC's: timestamp in ns, x, y, z, qw, qx, qy, qz, whatever else; `#` starts a comment

Which way the axes point is found from how it moves, see `sequences.odometry_axes`.

Formats: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats,
https://www.cvlibs.net/datasets/kitti/eval_odometry.php,
https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion.arrays import FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from sequences.odometry_axes import planar
from sequences.trajectory_io import finite_number, read_poses, rising_stamp, text_fields, unit_rotation

Poses = tuple[IntArray, FloatArray, Rotation]
"""Stamps (N,), positions (N, 3), rotations."""
_EUROC_COLUMNS = 8
_KITTI_COLUMNS = 12
_ORTHOGONAL = 1e-2


def read_odometry(path: Path, name: str, scan_stamps_ns: Callable[[], NDArray[np.int64]] | None = None) -> Trajectory:
    """Read a file in one of the formats, by its ending.

    Parameters
    ----------
    path, name
        The file, and the odometry's name.
    scan_stamps_ns
        Gives the stamps of the scans, (N,), for a format that has none of its own.

    Raises
    ------
    SkyfixError
        If the file is missing, empty or unreadable, a line is not what it should be, a stamp does not increase, there
        are not as many lines as scans in a format without stamps, or the axes are neither a body's nor a camera's.
    """
    stamps, positions, rotations = FORMATS[path.suffix](path, scan_stamps_ns)
    return Trajectory(stamps, planar(positions, rotations, name), None, name)


def _read_tum(path: Path, _: Callable[[], NDArray[np.int64]] | None) -> Poses:
    return read_poses(path)


def _read_txt(path: Path, scan_stamps_ns: Callable[[], NDArray[np.int64]] | None) -> Poses:
    first = next(text_fields(path), None)
    if first is None or len(first[1]) != _KITTI_COLUMNS:
        return read_poses(path)
    rows = []
    for number, fields in text_fields(path):
        if len(fields) != _KITTI_COLUMNS:
            raise SkyfixError(f"{path.name}: line {number}: expected 12 numbers (3 x 4), got {len(fields)}")
        rows.append([finite_number(field, path, number) for field in fields])
        turn = np.array(rows[-1]).reshape(3, 4)[:, :3]
        if not np.allclose(turn @ turn.T, np.eye(3), atol=_ORTHOGONAL) or np.linalg.det(turn) < 0.0:
            raise SkyfixError(f"{path.name}: line {number}: expected a rotation in the first three columns, got none")
    stamps = np.zeros(0, np.int64) if scan_stamps_ns is None else scan_stamps_ns()
    if len(rows) != len(stamps):
        raise SkyfixError(f"{path.name}: expected a pose for each of {len(stamps)} scans, got {len(rows)}")
    matrices = np.array(rows).reshape(-1, 3, 4)
    return stamps, matrices[:, :, 3], Rotation.from_matrix(matrices[:, :, :3])


def _read_csv(path: Path, _: Callable[[], NDArray[np.int64]] | None) -> Poses:
    stamps: list[int] = []
    rows, quaternions = [], []
    for number, fields in text_fields(path, ","):
        if len(fields) < _EUROC_COLUMNS:
            raise SkyfixError(
                f"{path.name}: line {number}: expected at least 8 numbers (ns, x, y, z, qw, qx, qy, qz), "
                f"got {len(fields)}"
            )
        stamps.append(rising_stamp(fields[0], path, number, stamps, unit="ns"))
        values = [finite_number(field, path, number) for field in fields[1:_EUROC_COLUMNS]]
        rows.append(values[:3])
        quaternions.append(unit_rotation([*values[4:], values[3]], path, number))
    if not stamps:
        raise SkyfixError(f"{path.name}: expected at least one pose, got none")
    return np.array(stamps, dtype=np.int64), np.array(rows), Rotation.from_quat(np.array(quaternions))


FORMATS: Mapping[str, Callable[[Path, Callable[[], NDArray[np.int64]] | None], Poses]] = {
    ".tum": _read_tum,
    ".txt": _read_txt,
    ".csv": _read_csv,
}
"""What an odometry's file may end in."""
