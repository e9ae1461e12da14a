"""Scans on disk as KITTI's velodyne files have them: float32 (x, y, z, reflectance), little-endian, nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.errors import SkyfixError
from sequences.sequence import SCAN_COLUMNS, ScanError, checked_points

_BYTES_PER_POINT = SCAN_COLUMNS * 4


def read_points(path: Path) -> NDArray[np.float32]:
    """Points (N, 4) float32 of a scan file, metres, reflectance in 0..1.

    Raises
    ------
    ScanError
        If the file is unreadable or of wrong length, holds no points, or one that is not finite.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ScanError(f"scan {path.name}: cannot be read: {error.strerror}") from error
    if len(content) % _BYTES_PER_POINT:
        raise ScanError(
            f"scan {path.name}: expected a multiple of {_BYTES_PER_POINT} bytes (float32 x, y, z, reflectance), "
            f"got {len(content)}"
        )
    points = np.frombuffer(content, dtype="<f4").astype(np.float32).reshape(-1, SCAN_COLUMNS)
    return checked_points(points, f"scan {path.name}")


def frame_number(file: Path) -> int:
    """The number that a file is named by; `SkyfixError` when it is named otherwise."""
    if not (file.stem.isascii() and file.stem.isdigit()):
        raise SkyfixError(f"{file}: expected a file named by a frame's number, got {file.name}")
    return int(file.stem)
