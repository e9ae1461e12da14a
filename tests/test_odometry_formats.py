"""Odometry in the formats of other programs: all move the vehicle alike, broken files are one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_drive import MadeDrive
from scipy.spatial.transform import Rotation

from fusion import se2
from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from sequences.folder import FolderSequence
from sequences.odometry_formats import read_odometry
from sequences.trajectory_io import write_tum

WINDING = np.array([[0.0, 0.0, 0.3]])
for turn in np.linspace(0.1, -0.2, 19):
    WINDING = np.vstack([WINDING, se2.compose(WINDING[-1], np.array([1.0, 0.0, turn]))])
STAMPS = 1_700_000_000_123_456_789 + np.arange(20, dtype=np.int64) * 100_000_000
OF_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""A camera's right, down, forward in a body's forward, left, up."""


def write_txt(path: Path, camera: bool) -> None:
    """KITTI's matrices, of a body or of a camera in its first frame."""
    rotations = Rotation.from_euler("z", WINDING[:, 2:]).as_matrix()
    positions = np.column_stack([WINDING[:, :2], np.zeros(20)])
    if camera:
        rotations, positions = OF_CAMERA.T @ rotations @ OF_CAMERA, positions @ OF_CAMERA
    np.savetxt(path, np.concatenate([rotations, positions[:, :, None]], axis=2).reshape(20, 12), fmt="%.9e")


def write_csv(path: Path, columns: int) -> None:
    half = 0.5 * WINDING[:, 2]
    lines = ["#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z [],v_x [m s^-1]"]
    for stamp, (x, y, _), angle in zip(STAMPS, WINDING, half, strict=True):
        values = [x, y, 0.3, np.cos(angle), 0.0, 0.0, np.sin(angle), *[7.0] * (columns - 8)]
        lines.append(f"{stamp}, " + ", ".join(f"{value:.12f}" for value in values))
    path.write_text("\n".join(lines))


@pytest.mark.parametrize(
    ("suffix", "write"),
    [
        (".tum", lambda path: write_tum(path, Trajectory(STAMPS, WINDING))),
        (".txt", lambda path: write_tum(path, Trajectory(STAMPS, WINDING))),
        (".txt", lambda path: write_txt(path, camera=False)),
        (".csv", lambda path: write_csv(path, 8)),
        (".csv", lambda path: write_csv(path, 17)),
    ],
    ids=["tum", "tum in txt", "kitti", "euroc", "euroc with more"],
)
def test_poses_come_back(tmp_path: Path, suffix: str, write: Callable[[Path], None]) -> None:
    write(tmp_path / f"mine{suffix}")
    found = read_odometry(tmp_path / f"mine{suffix}", "mine", lambda: STAMPS)
    assert found.frame_id == "mine"
    np.testing.assert_array_equal(found.stamp_ns, STAMPS)
    np.testing.assert_allclose(found.poses, WINDING, atol=1e-8)


def test_a_camera_s_matrices_move_the_vehicle_alike(tmp_path: Path) -> None:
    write_txt(tmp_path / "orb.txt", camera=True)
    found = read_odometry(tmp_path / "orb.txt", "orb", lambda: STAMPS)
    moved = [np.hypot(*np.diff(poses[:, :2], axis=0).T) for poses in (found.poses, WINDING)]
    np.testing.assert_allclose(moved[0], moved[1], atol=1e-7)
    np.testing.assert_allclose(np.diff(found.poses[:, 2]), np.diff(WINDING[:, 2]), atol=1e-7)


def test_a_folder_lists_and_reads_them_all(made_drive: MadeDrive) -> None:
    """KITTI's have the stamps of the scans."""
    folder = made_drive.path / "odometry"
    matrices = np.zeros((30, 3, 4))
    matrices[:, :, :3] = Rotation.from_euler("z", made_drive.odometry.poses[:, 2:]).as_matrix()
    matrices[:, :2, 3] = made_drive.odometry.poses[:, :2]
    np.savetxt(folder / "icp.txt", matrices.reshape(30, 12))
    write_csv(folder / "vins.csv", 8)
    (folder / "notes.md").write_text("not an odometry")
    sequence = FolderSequence(made_drive.path)
    assert sequence.odometry_names == ("icp", "vins", "wheels")
    icp = sequence.odometry("icp")
    np.testing.assert_array_equal(icp.stamp_ns, sequence.stamps_ns)
    np.testing.assert_allclose(icp.poses, sequence.odometry("wheels").poses, atol=1e-6)
    write_tum(folder / "icp.tum", made_drive.odometry)
    with pytest.raises(SkyfixError, match=r"odometry: expected one file of a name, got icp\.tum and icp\.txt"):
        FolderSequence(made_drive.path)


MATRIX = "1 0 0 0 0 1 0 0 0 0 1 0"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.txt", f"{MATRIX}\n1 0 0", r"a\.txt: line 2: expected 12 numbers \(3 x 4\), got 3"),
        ("a.txt", MATRIX.replace("1", "2"), r"a\.txt: line 1: expected a rotation in the first three columns"),
        ("a.txt", "-" + MATRIX, r"a\.txt: line 1: expected a rotation"),
        ("a.txt", MATRIX.replace("1", "nan", 1), r"a\.txt: line 1: expected a finite number, got nan"),
        ("a.txt", MATRIX, r"a\.txt: expected a pose for each of 20 scans, got 1"),
        ("a.txt", "1 2 3", r"a\.txt: line 1: expected 8 numbers \(t x y z qx qy qz qw\), got 3"),
        ("a.txt", "", r"a\.txt: expected at least one pose, got none"),
        ("a.csv", "1,0,0,0,1,0,0", r"a\.csv: line 1: expected at least 8 numbers \(ns, x, y, z, qw, qx, qy, qz\)"),
        ("a.csv", "t,x,y,z,qw,qx,qy,qz", r"a\.csv: line 1: expected a number, got 't'"),
        ("a.csv", "1,0,0,0,0,0,0,0", r"a\.csv: line 1: expected a unit quaternion, got zero length"),
        ("a.csv", "2,0,0,0,1,0,0,0\n2,0,0,0,1,0,0,0", r"a\.csv: line 2: stamps must increase, got 2 ns after 2 ns"),
        ("a.csv", "# nothing", r"a\.csv: expected at least one pose, got none"),
        ("a.csv", None, r"a\.csv: cannot be read"),
    ],
)
def test_broken_files_are_one_line(tmp_path: Path, name: str, content: str | None, message: str) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(SkyfixError, match=message) as caught:
        read_odometry(tmp_path / name, "a", lambda: STAMPS)
    assert "\n" not in str(caught.value)


def test_matrices_need_scans_to_have_their_stamps_of(tmp_path: Path) -> None:
    write_txt(tmp_path / "a.txt", camera=False)
    with pytest.raises(SkyfixError, match=r"a\.txt: expected a pose for each of 0 scans, got 20"):
        read_odometry(tmp_path / "a.txt", "a")
