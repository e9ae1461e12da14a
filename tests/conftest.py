"""Fixtures for everybody: real sequences where the machine has them, and a small made-up drive on disk."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_drive import MadeDrive, write_made_drive

_DATA_VARIABLE = "SKYFIX_DATA"
_DATA_BESIDE_REPOSITORY = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Give a function from a real sequence's name to its folder, scans unpacked; without data it skips the test."""
    root = Path(os.environ.get(_DATA_VARIABLE, _DATA_BESIDE_REPOSITORY))
    unpacked: dict[str, Path] = {}

    def folder(name: str) -> Path:
        if not (root / name / "map.json").is_file():
            pytest.skip(f"needs the sequence {name}: set {_DATA_VARIABLE} to the folder that holds it")
        if name not in unpacked:
            unpacked[name] = _unpack(root / name, tmp_path_factory.mktemp("data") / name)
        return unpacked[name]

    return folder


@pytest.fixture
def made_drive(tmp_path: Path) -> MadeDrive:
    """A small made-up drive in the folder format; a test may spoil its files."""
    return write_made_drive(tmp_path / "made_drive")


def _unpack(source: Path, target: Path) -> Path:
    shutil.copytree(source, target, ignore=shutil.ignore_patterns("scans.npz"))
    if (source / "scans.npz").exists():
        (target / "scans").mkdir()
        with np.load(source / "scans.npz") as packed:
            unit = float(packed["metres_per_unit"])
            columns = [packed[axis] * unit for axis in "xyz"] + [packed["reflectance"] / 255.0]
            cloud = np.stack(columns, axis=1).astype(np.float32)
            for index, points in enumerate(np.split(cloud, np.cumsum(packed["count"])[:-1])):
                points.tofile(target / "scans" / f"{index:06d}.bin")
            np.savetxt(target / "scans" / "times.txt", packed["t"], fmt="%.6f")
    return target
