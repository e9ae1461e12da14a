"""Trajectories as TUM text files: a line is `t x y z qx qy qz qw`, seconds and metres, `#` starts a comment.

Seconds are decimal text and stamps are int64 nanoseconds, so the conversion goes through `decimal`: a float would
lose the last digits of a Unix time. The z coordinate, roll and pitch are dropped on reading and written as zero.
Format: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from sequences.odometry_axes import on_the_ground

_NS_PER_S = 1_000_000_000
_LATEST_NS = 2**63 - 1
_TUM_COLUMNS = 8


def read_tum(path: Path, frame_id: str = "map") -> Trajectory:
    """Read a TUM file of a body with x forward, in a frame with z up.

    Parameters
    ----------
    path
        The file.
    frame_id
        The frame that the poses are in (`map`, or a name of the odometry's own).

    Raises
    ------
    SkyfixError
        If the file is missing, empty or unreadable, a line is not eight finite numbers, a quaternion has no length,
        or a stamp does not increase. The message names the file and the line.
    """
    stamps, positions, rotations = read_poses(path)
    return Trajectory(stamps, on_the_ground(positions, rotations), None, frame_id)


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write stamps and planar poses (z, roll and pitch zero). Stamps survive to the nanosecond."""
    lines = []
    for stamp, (x, y, yaw) in zip(trajectory.stamp_ns.tolist(), trajectory.poses.tolist(), strict=True):
        rotation = f"0.000000000000 0.000000000000 {np.sin(0.5 * yaw):.12f} {np.cos(0.5 * yaw):.12f}"
        lines.append(f"{format_seconds(stamp)} {x:.9f} {y:.9f} 0.000000000 {rotation}\n")
    path.write_text("".join(lines), encoding="ascii")


def read_times(path: Path) -> NDArray[np.int64]:
    """Read `times.txt` (seconds, one a line) as (N,) int64 nanoseconds; raises `SkyfixError` as `read_tum` does."""
    stamps: list[int] = []
    for number, fields in text_fields(path):
        if len(fields) != 1:
            raise SkyfixError(f"{path.name}: line {number}: expected one number (seconds), got {len(fields)}")
        stamps.append(rising_stamp(fields[0], path, number, stamps))
    if not stamps:
        raise SkyfixError(f"{path.name}: expected at least one stamp, got none")
    return np.array(stamps, dtype=np.int64)


def format_seconds(stamp_ns: int) -> str:
    """Nanoseconds as exact decimal seconds with nine digits."""
    sign, magnitude = ("-" if stamp_ns < 0 else ""), abs(stamp_ns)
    return f"{sign}{magnitude // _NS_PER_S}.{magnitude % _NS_PER_S:09d}"


def read_poses(path: Path) -> tuple[NDArray[np.int64], FloatArray, Rotation]:
    """Stamps (N,), positions (N, 3) and N rotations of a TUM file; raises `SkyfixError` as `read_tum` does."""
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, fields in text_fields(path):
        if len(fields) != _TUM_COLUMNS:
            raise SkyfixError(
                f"{path.name}: line {number}: expected 8 numbers (t x y z qx qy qz qw), got {len(fields)}"
            )
        stamps.append(rising_stamp(fields[0], path, number, stamps))
        pose = [finite_number(field, path, number) for field in fields[1:]]
        rows.append([*pose[:3], *unit_rotation(pose[3:], path, number)])
    if not stamps:
        raise SkyfixError(f"{path.name}: expected at least one pose, got none")
    values = np.array(rows, dtype=np.float64)
    return np.array(stamps, dtype=np.int64), values[:, :3], Rotation.from_quat(values[:, 3:])


def text_fields(path: Path, separator: str | None = None) -> Iterator[tuple[int, list[str]]]:
    """Number and fields of every line that has any, comments taken off; white space separates where nothing else does.

    Raises
    ------
    SkyfixError
        If the file is missing or not of text.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise SkyfixError(f"{path}: cannot be read: {reason}") from error
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.split("#", 1)[0].strip()
        if content:
            yield number, [field.strip() for field in content.split(separator)]


def rising_stamp(field: str, path: Path, number: int, earlier: list[int], unit: Literal["s", "ns"] = "s") -> int:
    """Nanoseconds of a field, which have to be more than the last of the earlier ones; `SkyfixError` otherwise."""
    finite_number(field, path, number)
    stamp = int((Decimal(field) * (_NS_PER_S if unit == "s" else 1)).to_integral_value())
    if abs(stamp) > _LATEST_NS:
        expected = "seconds up to 9.2e9, not nanoseconds" if unit == "s" else "nanoseconds of 64 bits"
        raise SkyfixError(f"{path.name}: line {number}: expected {expected}, got {field}")
    if earlier and stamp <= earlier[-1]:
        before = format_seconds(earlier[-1]) if unit == "s" else earlier[-1]
        raise SkyfixError(f"{path.name}: line {number}: stamps must increase, got {field} {unit} after {before} {unit}")
    return stamp


def finite_number(field: str, path: Path, number: int) -> float:
    """The number that a field of a line holds; `SkyfixError` if there is none or it is not finite."""
    try:
        value = float(Decimal(field))
    except InvalidOperation:
        raise SkyfixError(f"{path.name}: line {number}: expected a number, got {field!r}") from None
    if not np.isfinite(value):
        raise SkyfixError(f"{path.name}: line {number}: expected a finite number, got {field}")
    return value


def unit_rotation(quaternion: list[float], path: Path, number: int) -> list[float]:
    """The quaternion x, y, z, w of a line, of any length; `SkyfixError` if it has none."""
    if np.linalg.norm(quaternion) < 1e-6:
        raise SkyfixError(f"{path.name}: line {number}: expected a unit quaternion, got zero length")
    return quaternion
