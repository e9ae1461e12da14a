"""What explains that scans do not match: other axes, a map upside down, another clock, a map elsewhere."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from made_drive import EmulatedMatcher, MadeDrive
from numpy.typing import NDArray

from fusion import se2
from fusion.errors import SkyfixError
from fusion.likelihood import LikelihoodVolume
from fusion.trajectory import Trajectory
from learned.map_raster import MapRaster
from learned.matcher import SearchRegion
from sequences.check import Finding, Level, check
from sequences.check_matching import _AXES
from sequences.folder import FolderSequence
from sequences.sequence import Sequence
from sequences.trajectory_io import write_tum

LANDMARK = np.array([11.0, 6.0, 1.5], np.float32)


@dataclass
class SeeingMatcher(EmulatedMatcher):
    """Knows the truth where the scan's landmark, its first point, is in its place and the map's north is built up."""

    built_up: bool = False

    def match(
        self, points: NDArray[np.float32], ground_z: float, map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume:
        north = map_raster.picture[: map_raster.grid.rows // 2].any()
        sees = np.allclose(points[0, :3], LANDMARK) and (north or not self.built_up)
        index = round(float(points[0, 3]) * 1000)
        known = self.truth[index] if sees else search.centre + [8.0, 8.0, 0.1] * np.sin([3.0 * index, 5.0 * index, 0.0])
        return EmulatedMatcher(np.tile(known, (index + 1, 1))).match(points, ground_z, map_raster, search)


@pytest.fixture
def drive(made_drive: MadeDrive) -> FolderSequence:
    write_scans(made_drive, np.eye(3))
    return FolderSequence(made_drive.path)


def write_scans(made: MadeDrive, turn: NDArray[np.float64]) -> None:
    for index in range(len(made.truth)):
        points = np.random.default_rng(index).uniform(-20.0, 20.0, size=(2000, 4)).astype(np.float32)
        points[:, 2], points[:, 3] = -1.7, index / 1000.0
        points[0, :3] = LANDMARK
        points[:, :3] = points[:, :3] @ turn
        points.tofile(made.scan_file(index))


def matching(sequence: Sequence, matcher: EmulatedMatcher) -> Finding:
    (found,) = [finding for finding in check(sequence, matcher) if finding.subject == "matching"]
    return found


def test_what_matches_is_not_explained(drive: FolderSequence, made_drive: MadeDrive) -> None:
    found = matching(drive, SeeingMatcher(made_drive.truth.poses))
    assert found.level is Level.OK
    assert found.text.endswith("100 % within 3 m")


@pytest.mark.parametrize("axes", _AXES)
def test_axes_of_another_convention_are_named(axes: str, drive: FolderSequence, made_drive: MadeDrive) -> None:
    turn = np.array(_AXES[axes], dtype=float)
    assert abs(np.linalg.det(turn)) == pytest.approx(1.0)
    write_scans(made_drive, turn)  # rows: p^T R is (R^T p)^T, which R brings back
    found = matching(FolderSequence(made_drive.path), SeeingMatcher(made_drive.truth.poses))
    assert found.level is Level.PROBLEM
    assert found.text.endswith(f"; 100 % if the scans' axes are {axes}")


def test_the_conventions_are_what_they_are_called() -> None:
    forward, left, up = np.eye(3)
    directions = {"forward": forward, "backward": -forward, "to the left": left, "to the right": -left}
    directions |= {"up": up, "down": -up}
    for axes, turn in _AXES.items():
        for axis, (name, direction) in enumerate(part.split(" ", 1) for part in axes.split(", ")):
            assert name == "xyz"[axis]
            np.testing.assert_array_equal(np.array(turn)[:, axis], directions[direction])


@pytest.mark.parametrize("built_up", ["north", "south"])
def test_a_map_that_is_upside_down_is_named(built_up: str, drive: FolderSequence, made_drive: MadeDrive) -> None:
    raster = drive.map
    half = raster.grid.rows // 2
    picture = np.zeros_like(raster.picture)
    picture[slice(0, half) if built_up == "north" else slice(raster.grid.rows - half, None)] = 200
    shown = replace(raster, classes=None, picture=picture)
    object.__setattr__(drive, "map", shown)
    found = matching(drive, SeeingMatcher(made_drive.truth.poses, built_up=True))
    assert (found.level is Level.OK) == (built_up == "north")
    assert found.text.endswith("100 % if row 0 of the map is south") == (built_up == "south")


@pytest.mark.parametrize(("late_s", "said"), [(0.6, "ahead of"), (-0.6, "behind")])
def test_a_truth_of_another_clock_is_named(late_s: float, said: str, made_drive: MadeDrive) -> None:
    truth = made_drive.truth
    shifted = Trajectory(truth.stamp_ns + round(late_s * 1e9), truth.poses)
    write_scans(made_drive, np.eye(3))
    write_tum(made_drive.path / "ground_truth.tum", shifted)
    found = matching(FolderSequence(made_drive.path), EmulatedMatcher(truth.poses))
    assert found.level is Level.PROBLEM
    seconds, _, rest = found.text.rpartition("most are ")[2].partition(" s ")
    assert float(seconds) == pytest.approx(0.6, abs=0.06)
    assert rest == f"{said} the truth: one clock?"


def test_a_map_elsewhere_is_told_by_how_much(made_drive: MadeDrive) -> None:
    write_scans(made_drive, np.eye(3))
    displaced = made_drive.truth.poses + [9.0, -7.0, 0.0]
    found = matching(FolderSequence(made_drive.path), EmulatedMatcher(displaced, sigma_m=0.3))
    told = re.search(r"most are x (\S+) m, y (\S+) m from the truth: is the map where it says\?$", found.text)
    assert told is not None
    east, north = map(float, told.groups())
    assert (east, north) == (pytest.approx(9.0, abs=0.4), pytest.approx(-7.0, abs=0.4))


def test_a_truth_whose_headings_are_wrong_explains_enough(drive: FolderSequence, made_drive: MadeDrive) -> None:
    backwards = se2.compose(made_drive.truth.poses, np.array([0.0, 0.0, np.pi]))
    write_tum(made_drive.path / "ground_truth.tum", Trajectory(made_drive.truth.stamp_ns, backwards))
    write_scans(made_drive, np.diag([-1.0, -1.0, 1.0]))
    found = matching(FolderSequence(made_drive.path), SeeingMatcher(backwards))
    assert found.level is Level.PROBLEM
    assert found.text.endswith("% within 3 m")


def test_what_nothing_explains_is_not_explained(made_drive: MadeDrive) -> None:
    write_scans(made_drive, np.eye(3))
    rng = np.random.default_rng(0)
    nowhere = se2.compose(made_drive.truth.poses, rng.uniform(-15.0, 15.0, (30, 3)) * [1.0, 1.0, 0.0])
    found = matching(FolderSequence(made_drive.path), EmulatedMatcher(nowhere))
    assert found.level is Level.PROBLEM
    assert found.text.endswith("% within 3 m")


def test_no_usable_scan_with_a_true_pose_is_said(made_drive: MadeDrive, tmp_path: Path) -> None:
    write_scans(made_drive, np.eye(3))
    for index in range(10):
        made_drive.scan_file(index).write_bytes(b"")
    truth = made_drive.truth
    write_tum(made_drive.path / "ground_truth.tum", Trajectory(truth.stamp_ns[:8], truth.poses[:8]))
    found = matching(FolderSequence(made_drive.path), EmulatedMatcher(truth.poses))
    assert found.text == "made_drive: expected a usable scan, got none in 8"
    with pytest.raises(SkyfixError, match="expected a sequence folder"):
        check(FolderSequence(tmp_path / "none"))
