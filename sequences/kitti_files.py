"""Small text files of KITTI: lists of date-times, calibrations of `KEY: numbers` lines, rows of numbers.

Source: Geiger, Lenz, Stiller, Urtasun, "Vision meets robotics: the KITTI dataset", IJRR 2013, and its development
kits. A transform is a (4, 4) float64 matrix named target_from_source.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError

VELODYNE_GROUND_Z = -1.73
"""Height of the road in the frame of KITTI's Velodyne, metres (the sensor set-up of the paper)."""

_DATE_TIME = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(?:\.(\d{1,9}))?")
_ORTHOGONAL_WITHIN = 1e-3


def read_text(path: Path) -> str:
    """The text of a file; `SkyfixError` when it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise SkyfixError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError:
        raise SkyfixError(f"{path}: cannot be read: not a text file") from None


def read_rows(path: Path, columns: int) -> FloatArray:
    """(N, columns) numbers of a file with so many on each line.

    Raises
    ------
    SkyfixError
        If the file cannot be read, is empty, or a line is not so many finite numbers.
    """
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    if not lines:
        raise SkyfixError(f"{path}: expected lines of {columns} numbers, got an empty file")
    return np.array([numbers(line.split(), columns, f"{path}: line {at}") for at, line in enumerate(lines, start=1)])


def numbers(fields: list[str], count: int, label: str) -> list[float]:
    """So many finite numbers; `SkyfixError` that begins with the label otherwise."""
    if len(fields) != count:
        raise SkyfixError(f"{label}: expected {count} numbers, got {len(fields)}")
    try:
        values = [float(field) for field in fields]
    except ValueError as error:
        raise SkyfixError(f"{label}: expected {count} numbers, {error}") from None
    if not np.isfinite(values).all():
        raise SkyfixError(f"{label}: expected finite numbers, got NaN or infinity")
    return values


def read_date_times(path: Path) -> NDArray[np.int64]:
    """Stamps (N,) int64 nanoseconds of `timestamps.txt`, a line `2011-09-26 13:02:25.964389445` each, taken as UTC.

    Raises
    ------
    SkyfixError
        If the file cannot be read or is empty, or a line is no date and time or not later than the one before.
    """
    stamps: list[int] = []
    for at, line in enumerate(read_text(path).split("\n"), start=1):
        if not line.strip():
            continue
        found = _DATE_TIME.fullmatch(line.strip())
        try:
            whole = datetime.fromisoformat(found[1]).replace(tzinfo=UTC) if found else None
        except ValueError:
            whole = None
        if found is None or whole is None:
            raise SkyfixError(f"{path}: line {at}: expected a date and a time, got {line.strip()!r}")
        stamps.append(int(whole.timestamp()) * 1_000_000_000 + int((found[2] or "").ljust(9, "0")))
        if len(stamps) > 1 and stamps[-1] <= stamps[-2]:
            raise SkyfixError(f"{path}: line {at}: stamps must increase, got {line.strip()!r}")
    if not stamps:
        raise SkyfixError(f"{path}: expected dates and times, got an empty file")
    return np.array(stamps, dtype=np.int64)


def read_calibration(path: Path, *keys: str) -> list[FloatArray]:
    """The numbers under each key of a calibration file; `SkyfixError` when one is missing or holds none."""
    entries = dict(line.split(":", 1) for line in read_text(path).splitlines() if ":" in line)
    found = []
    for key in keys:
        if key not in entries:
            raise SkyfixError(f"{path}: expected a line {key!r}, got {', '.join(entries) or 'none'}")
        fields = entries[key].split()
        found.append(np.array(numbers(fields, len(fields), f"{path}: {key}")))
    return found


def rigid(rotation: FloatArray, translation: FloatArray, label: str) -> FloatArray:
    """The (4, 4) matrix of a rotation, nine numbers by rows, and a translation of three.

    Raises
    ------
    SkyfixError
        If the counts are wrong or the nine numbers are no rotation.
    """
    if rotation.size != 9 or translation.size != 3:
        raise SkyfixError(
            f"{label}: expected a rotation of 9 numbers and a translation of 3, got {rotation.size} and "
            f"{translation.size}"
        )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.reshape(3, 3)
    matrix[:3, 3] = translation
    turn = matrix[:3, :3]
    if np.abs(turn @ turn.T - np.eye(3)).max() > _ORTHOGONAL_WITHIN or np.linalg.det(turn) < 0.0:
        raise SkyfixError(f"{label}: expected a rotation matrix, got {rotation.round(3).tolist()}")
    return matrix


def inverse(target_from_source: FloatArray) -> FloatArray:
    """source_from_target of a rigid (4, 4) matrix."""
    matrix = np.eye(4)
    matrix[:3, :3] = target_from_source[:3, :3].T
    matrix[:3, 3] = -target_from_source[:3, :3].T @ target_from_source[:3, 3]
    return matrix


def planar(matrices: FloatArray) -> FloatArray:
    """Poses (..., 3) of (..., 4, 4) matrices: x, y and the direction of the x axis on the plane."""
    return np.stack(
        [matrices[..., 0, 3], matrices[..., 1, 3], np.arctan2(matrices[..., 1, 0], matrices[..., 0, 0])], axis=-1
    )
