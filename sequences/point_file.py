"""Scans on disk: what KITTI's velodyne files hold, and the formats that point clouds are usually kept in.

    .bin    float32 (x, y, z, reflectance), little-endian, nothing else: KITTI's
    .npy    an array (N, 3) or (N, 4) of these, as numpy saves it
    .pcd    the Point Cloud Library's format, any encoding (extra `clouds`, package pypcd4)
    .ply    ASCII or binary (extra `clouds`, package trimesh)

A .bin has to be exactly that, but for missing returns: points whose x, y and z are all NaN are left out. Of the others
all points that are not finite are left out, and the reflectance is what `intensity`, `reflectance` or `reflectivity`
says, see `scan_of`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.errors import SkyfixError
from sequences.sequence import SCAN_COLUMNS, ScanError, checked_points

REFLECTANCE = ("intensity", "reflectance", "reflectivity")
"""Names that the reflectance goes by, the first that is there counts."""
_BYTES_PER_POINT = SCAN_COLUMNS * 4


def read_points(path: Path) -> NDArray[np.float32]:
    """Points (N, 4) float32 of a scan file, metres, reflectance in 0..1.

    Raises
    ------
    ScanError
        If the file is unreadable or not of its format, holds no points, or, a .bin, one that is not finite and no
        missing return.
    SkyfixError
        If the package that reads the format is not installed.
    """
    label = f"scan {path.name}"
    try:
        columns = READERS[path.suffix](path)
    except OSError as error:
        raise ScanError(f"{label}: cannot be read: {error.strerror or error}") from error
    except ImportError as error:
        raise SkyfixError(
            f"{label}: {path.suffix} needs the package {error.name}: pip install 'skyfix[clouds]'"
        ) from error
    except ScanError as error:
        raise ScanError(f"{label}: {error}") from error
    except Exception as error:  # what readers of other people's make of a broken file is anything
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ScanError(f"{label}: cannot be read as {path.suffix}: {reason}") from error
    return checked_points(columns if isinstance(columns, np.ndarray) else scan_of(columns, label), label)


def scan_of(columns: Mapping[str, NDArray[Any]], label: str) -> NDArray[np.float32]:
    """Points (N, 4) float32 of named columns, in 0..1 the last; points that are not finite are left out.

    The reflectance is in 0..1 or, where a scan has larger ones, in 0..255 and divided by that; without a column it is
    0.

    Raises
    ------
    ScanError
        If x, y or z is missing, or no point is finite.
    """
    if any(name not in columns for name in "xyz"):
        raise ScanError(f"{label}: expected fields x, y, z, got {', '.join(columns) or 'none'}")
    names = ["x", "y", "z", *[name for name in REFLECTANCE if name in columns][:1]]
    points = np.zeros((len(columns["x"]), SCAN_COLUMNS), np.float32)
    for column, name in enumerate(names):
        points[:, column] = columns[name]
    points = points[np.isfinite(points[:, :3]).all(axis=1)]
    if len(points) == 0:
        raise ScanError(f"{label}: expected points, got none that is finite")
    points[:, 3] = np.nan_to_num(points[:, 3], nan=0.0, posinf=0.0, neginf=0.0)
    if points[:, 3].max() > 1.0:
        points[:, 3] = np.clip(points[:, 3] / 255.0, 0.0, 1.0)
    return points


def frame_number(file: Path) -> int:
    """The number that a file is named by; `SkyfixError` when it is named otherwise."""
    if not (file.stem.isascii() and file.stem.isdigit()):
        raise SkyfixError(f"{file}: expected a file named by a frame's number, got {file.name}")
    return int(file.stem)


def _read_bin(path: Path) -> NDArray[np.float32]:
    content = path.read_bytes()
    if len(content) % _BYTES_PER_POINT:
        expected = f"a multiple of {_BYTES_PER_POINT} bytes (float32 x, y, z, reflectance)"
        raise ScanError(f"expected {expected}, got {len(content)}")
    points = np.frombuffer(content, dtype="<f4").astype(np.float32).reshape(-1, SCAN_COLUMNS)
    return points[~np.isnan(points[:, :3]).all(axis=1)]


def _read_npy(path: Path) -> Mapping[str, NDArray[Any]]:
    points = np.load(path, allow_pickle=False)
    if points.ndim != 2 or points.shape[1] not in (3, SCAN_COLUMNS) or points.dtype.kind not in "fiu":
        raise ScanError(f"expected an array (N, 3) or (N, 4) of numbers, got {points.shape} {points.dtype}")
    return dict(zip(("x", "y", "z", REFLECTANCE[0]), points.T, strict=False))


def _read_pcd(path: Path) -> Mapping[str, NDArray[Any]]:
    from pypcd4 import PointCloud

    cloud = PointCloud.from_path(path)
    return {name: cloud.pc_data[name] for name in cloud.fields}


def _read_ply(path: Path) -> Mapping[str, NDArray[Any]]:
    import trimesh

    vertices = trimesh.load(path, process=False).metadata["_ply_raw"]["vertex"]["data"]
    names = vertices.dtype.names if isinstance(vertices, np.ndarray) else vertices
    return {name: np.ravel(vertices[name]) for name in names}


READERS: Mapping[str, Callable[[Path], NDArray[np.float32] | Mapping[str, NDArray[Any]]]] = {
    ".bin": _read_bin,
    ".npy": _read_npy,
    ".pcd": _read_pcd,
    ".ply": _read_ply,
}
"""What a scan's file may end in."""
