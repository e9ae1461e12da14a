"""KITTI raw and odometry layouts: landmarks planted on the earth must appear on the map whatever the heading."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from kitti_layout import (
    CENTRE,
    DRIVE,
    FRAMES,
    GEOD,
    LANDMARKS,
    MAP_ORIGIN,
    frames,
    map_xy,
    odometry_truth,
    write_folder_map,
    write_odometry_sequence,
    write_osm,
    write_raw,
)
from scipy.spatial.transform import Rotation

from fusion import se2
from fusion.errors import SkyfixError
from learned.map_raster import CLASS_INDEX
from sequences.kitti import GPS_AIDED, KittiDrive
from sequences.kitti_files import planar, read_date_times
from sequences.kitti_odometry import KittiOdometrySequence
from sequences.oxts import map_from_imu
from sequences.sequence import ScanError, Sequence
from sequences.trajectory_io import write_tum


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A raw drive, no map yet."""
    return write_raw(tmp_path)


def assert_landmarks_are_where_they_are(sequence: Sequence, known: np.ndarray) -> None:
    """Every scan's points, brought to the map by the truth, are the known places and lie on buildings."""
    truth = sequence.ground_truth
    assert truth is not None
    assert sequence.map.classes is not None
    poses = truth.interpolate(sequence.stamps_ns)
    assert len({int(quadrant) for quadrant in np.floor(poses[:, 2] / (np.pi / 2))}) == 4
    for index, pose in enumerate(poses):
        on_map = se2.transform_points(pose, sequence.scan(index)[:, :2].astype(np.float64))
        np.testing.assert_allclose(on_map, known, atol=0.01)
        rows, cols = np.floor(sequence.map.grid.pixel_from_xy(on_map)).astype(int).T
        assert (sequence.map.classes[rows, cols] == CLASS_INDEX["building"]).all()


@pytest.mark.parametrize("level", [0, 1, 2])
def test_landmarks_on_a_folder_map(drive: Path, level: int) -> None:
    write_folder_map([drive, *drive.parents][level])
    sequence = KittiDrive(drive)
    assert (sequence.name, sequence.ground_z, sequence.scans_simulated) == (DRIVE, -1.73, False)
    assert len(sequence.stamps_ns) == FRAMES
    assert_landmarks_are_where_they_are(sequence, np.array([map_xy(place, MAP_ORIGIN) for place in LANDMARKS]))


def test_landmarks_on_an_openstreetmap_extract_at_two_pixels_a_metre(drive: Path) -> None:
    write_osm(drive.parent / "karlsruhe.osm")
    sequence = KittiDrive(drive)
    first = frames()[0]
    known = np.array([map_xy(place, (first.lat, first.lon)) for place in LANDMARKS])
    assert_landmarks_are_where_they_are(sequence, known)
    assert sequence.map.grid.metres_per_pixel == 0.5
    assert sequence.ground_truth is not None
    for corner in np.array([[-92.0, -92.0], [-92.0, 92.0], [92.0, -92.0], [92.0, 92.0]]):
        assert sequence.map.grid.contains(sequence.ground_truth.poses[:, :2] + corner).all()


def test_attitude_is_roll_then_pitch_then_yaw_and_north_is_the_grids() -> None:
    place = (52.0, 11.0)  # far from the origin's meridian: the convergence is 2.3 degrees
    record = np.zeros((1, 30))
    record[0, :6] = [*place, 100.0, 0.1, -0.2, 0.7]
    pose = map_from_imu(record, (52.0, 8.0))[0]
    ahead_lon, ahead_lat, _ = pyproj_fwd(place, 90.0 - np.degrees(0.7))
    step = planar(map_from_imu(np.array([[ahead_lat, ahead_lon, *np.zeros(28)]]), (52.0, 8.0)))[0][:2] - pose[:2, 3]
    yaw = np.arctan2(step[1], step[0])
    assert abs(yaw - 0.7) > np.radians(2.0)
    np.testing.assert_allclose(pose[:3, :3], Rotation.from_euler("ZYX", [yaw, -0.2, 0.1]).as_matrix(), atol=2e-5)


def pyproj_fwd(place: tuple[float, float], azimuth: float) -> tuple[float, float, float]:
    return GEOD.fwd(place[1], place[0], azimuth, 10.0)


def test_odometries_of_a_drive(drive: Path) -> None:
    write_folder_map(drive)
    truth = KittiDrive(drive).ground_truth
    assert truth is not None
    (drive / "odometry").mkdir()
    write_tum(drive / "odometry" / "mine.tum", truth)
    sequence = KittiDrive(drive, seed=3)
    assert sequence.odometry_names == ("emulated", "mine", GPS_AIDED)
    reckoned = sequence.odometry(GPS_AIDED)
    np.testing.assert_array_equal(reckoned.stamp_ns, truth.stamp_ns)
    from_first = se2.between(truth.poses[:1], truth.poses)
    np.testing.assert_allclose(se2.between(reckoned.poses, from_first), 0.0, atol=0.02)
    np.testing.assert_allclose(sequence.odometry("mine").poses, truth.poses, atol=1e-8)
    emulated = sequence.odometry("emulated").poses
    np.testing.assert_array_equal(emulated, KittiDrive(drive, seed=3).odometry("emulated").poses)
    assert not np.array_equal(emulated, KittiDrive(drive, seed=4).odometry("emulated").poses)
    with pytest.raises(SkyfixError, match=r"odometry 'x': unknown for .*; there are: emulated, mine, oxts_gps_aided"):
        sequence.odometry("x")


def test_missing_scans_keep_the_stamps_of_the_others(drive: Path) -> None:
    write_folder_map(drive)
    whole = KittiDrive(drive)
    (drive / "velodyne_points" / "data" / "0000000004.bin").unlink()
    sequence = KittiDrive(drive)
    np.testing.assert_array_equal(sequence.stamps_ns, np.delete(whole.stamps_ns, 4))
    np.testing.assert_array_equal(sequence.scan(4), whole.scan(5))
    (drive / "velodyne_points" / "data" / "0000000006.bin").write_bytes(bytes(17))
    with pytest.raises(ScanError, match=r"scan 0000000006\.bin: expected a multiple of 16 bytes"):
        sequence.scan(5)


def test_dates_are_read_to_the_nanosecond(tmp_path: Path) -> None:
    file = tmp_path / "timestamps.txt"
    file.write_text("2011-09-26 13:02:25.964389445\n2011-09-26 13:02:26\n\n")
    np.testing.assert_array_equal(read_date_times(file), [1317042145964389445, 1317042146000000000])


def test_landmarks_of_an_odometry_sequence(tmp_path: Path) -> None:
    sequence = KittiOdometrySequence(write_odometry_sequence(tmp_path))
    assert sequence.name == "kitti_odometry_00"
    assert sequence.odometry_names == ("emulated",)
    assert_landmarks_are_where_they_are(sequence, np.array([map_xy(place, MAP_ORIGIN) for place in LANDMARKS]))
    assert sequence.ground_truth is not None
    expected = np.array([odometry_truth(index) for index in range(FRAMES)])
    np.testing.assert_allclose(sequence.ground_truth.poses[:, :2], expected[:, :2], atol=1e-3)
    centre = map_xy(CENTRE, MAP_ORIGIN)
    np.testing.assert_allclose(np.hypot(*(expected[:, :2] - centre).T), 30.0, atol=1.0)


@pytest.mark.parametrize("missing", ["poses", "placement"])
def test_an_odometry_sequence_without_truth(tmp_path: Path, missing: str) -> None:
    folder = write_odometry_sequence(tmp_path)
    (tmp_path / "poses" / "00.txt" if missing == "poses" else folder / "map_from_first.json").unlink()
    sequence = KittiOdometrySequence(folder)
    assert sequence.ground_truth is None
    assert sequence.odometry_names == ()
