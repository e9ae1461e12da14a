"""ROS bags become the folders of drives: what is in them, in which frame, and what is said when that cannot be."""

import json
from pathlib import Path
from types import SimpleNamespace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from made_bag import KINDS, MOUNTED_AT, MOUNTED_YAW, START_NS, STEP_NS, MadeBag, cloud_message, scan
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore
from typer.testing import CliRunner

from fusion import se2
from fusion.errors import SkyfixError
from sequences.bag_folder import BagRequest, write_bag_folder
from sequences.cli import app
from sequences.ground_height import estimate_ground_z
from sequences.odometry_formats import read_odometry
from sequences.point_cloud2 import points_of_message
from sequences.point_file import read_points
from sequences.rosbag import open_bag
from sequences.sequence import ScanError
from sequences.trajectory_io import read_times


def in_body(points: np.ndarray) -> np.ndarray:
    """The finite points of a made scan as the folder should have them."""
    points = points[np.isfinite(points[:, :3]).all(axis=1)].astype(float)
    c, s = np.cos(MOUNTED_YAW), np.sin(MOUNTED_YAW)
    xy = points[:, :2] @ np.array([[c, s], [-s, c]])
    return np.column_stack([np.column_stack([xy, points[:, 2]]) + MOUNTED_AT, points[:, 3] / 255.0])


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_becomes_a_drives_folder(tmp_path: Path, kind: str) -> None:
    path = MadeBag().write(tmp_path / ("drive.bag" if kind == "ros1" else "drive"), kind)
    target = tmp_path / "mine"
    with open_bag(path) as bag:
        content = write_bag_folder(bag, target, BagRequest())
    assert (content.scans, content.skipped, content.frame, content.mounted) == (4, 0, "base_link", True)
    assert content.first_fix == (49.01, 8.42)  # the first that the receiver calls one
    assert content.ground_z == pytest.approx(-1.7 + MOUNTED_AT[2], abs=0.01)
    assert sorted(file.name for file in target.iterdir()) == ["odometry", "scans", "sensor.json"]
    for index in range(4):
        written = read_points(target / "scans" / f"{index:06d}.bin")
        np.testing.assert_allclose(written, in_body(scan(index)), atol=2e-6)
    np.testing.assert_array_equal(read_times(target / "scans" / "times.txt"), START_NS + STEP_NS * np.arange(4))
    odometry = read_odometry(target / "odometry" / "wheels_odom.tum", "wheels_odom")
    np.testing.assert_array_equal(odometry.stamp_ns, START_NS + STEP_NS // 2 * np.arange(9))
    expected = np.column_stack([0.5 * np.arange(9), np.zeros(9), 0.02 * np.arange(9)])
    np.testing.assert_allclose(se2.between(odometry.poses[:1], odometry.poses), expected, atol=1e-6)
    assert json.loads((target / "sensor.json").read_text()) == {"ground_z": content.ground_z, "scans_simulated": False}


def test_an_unlinked_sensor_keeps_its_frame_and_that_is_said(tmp_path: Path) -> None:
    path = MadeBag(linked=False).write(tmp_path / "drive.bag", "ros1")
    with open_bag(path) as bag:
        content = write_bag_folder(bag, tmp_path / "mine", BagRequest(ground_z=-1.7, every=2))
        with pytest.raises(
            SkyfixError, match="frame: expected one that /tf_static connects with the scans' lidar, got x"
        ):
            write_bag_folder(bag, tmp_path / "other", BagRequest(frame="x"))
    assert (content.scans, content.frame, content.mounted, content.ground_z) == (2, "lidar", False, -1.7)
    points = scan(2)
    kept = points[np.isfinite(points[:, :3]).all(axis=1)]
    np.testing.assert_array_equal(read_points(tmp_path / "mine" / "scans" / "000001.bin")[:, :3], kept[:, :3])
    assert not (tmp_path / "other").exists()


def test_a_map_in_the_folder_stays_and_scans_do_not_get_mixed(tmp_path: Path) -> None:
    path = MadeBag().write(tmp_path / "drive.bag", "ros1")
    target = tmp_path / "mine"
    target.mkdir()
    (target / "map.json").write_text("{}")
    with open_bag(path) as bag:
        write_bag_folder(bag, target, BagRequest())
        assert (target / "map.json").read_text() == "{}"
        with pytest.raises(SkyfixError, match=r"one with a map alone, got one with scans, odometry, sensor\.json"):
            write_bag_folder(bag, target, BagRequest())
        with pytest.raises(SkyfixError, match=r"map\.json: cannot be written: Not a directory"):
            write_bag_folder(bag, target / "map.json", BagRequest())


def test_unusable_scans_are_counted_and_without_any_nothing_is_left(tmp_path: Path) -> None:
    made = MadeBag()
    made.scans[1] = np.full((5, 4), np.nan, np.float32)
    made.scan_stamps[3] = made.scan_stamps[2]
    with open_bag(made.write(tmp_path / "some.bag", "ros1")) as bag:
        content = write_bag_folder(bag, tmp_path / "some", BagRequest())
    assert (content.scans, content.skipped) == (2, 2)
    made.scans = [np.full((5, 4), np.nan, np.float32)] * 4
    with (
        open_bag(made.write(tmp_path / "none.bag", "ros1")) as bag,
        pytest.raises(SkyfixError, match="got 4 that cannot"),
    ):
        write_bag_folder(bag, tmp_path / "none", BagRequest())
    assert not (tmp_path / "none").exists()


def test_a_broken_pose_or_mounting_is_one_clear_error(tmp_path: Path) -> None:
    for made, message in (
        (MadeBag(odometry_x0=np.nan), "/wheels/odom: expected finite poses with a rotation, got 9 others"),
        (MadeBag(link_rotation=(0.0, 0.0, 0.0, 0.0)), "/tf_static: base_link to mast: expected a finite transform"),
    ):
        path = made.write(tmp_path / f"{len(list(tmp_path.iterdir()))}.bag", "ros1")
        with open_bag(path) as bag, pytest.raises(SkyfixError, match=message):
            write_bag_folder(bag, tmp_path / "mine", BagRequest())
        assert not (tmp_path / "mine").exists()


def test_topics_are_named_when_there_is_a_choice_or_none(tmp_path: Path) -> None:
    made = MadeBag(scan_topics=("/left", "/right"), odometry_topics=("/odom", "/rear/odom"))
    with open_bag(made.write(tmp_path / "drive.bag", "ros1")) as bag:
        for scans, got in (
            (None, "no choice"),
            ("/odom", r"/odom \(nav_msgs/msg/Odometry\)"),
            ("/up", r"/up \(not in the"),
        ):
            with pytest.raises(SkyfixError, match=f"one of its topics of scans, /left, /right; got {got}"):
                write_bag_folder(bag, tmp_path / "mine", BagRequest(scans=scans))
        content = write_bag_folder(bag, tmp_path / "mine", BagRequest("/left"))
        assert {name: round(length, 2) for name, length in content.odometry.items()} == {"odom": 4.0, "rear_odom": 4.0}
        one = write_bag_folder(bag, tmp_path / "one", BagRequest("/left", ("/odom",)))
        assert list(one.odometry) == ["odom"]


def test_the_command_says_what_it_found_and_what_comes_next(tmp_path: Path) -> None:
    path = MadeBag().write(tmp_path / "drive", "mcap")
    result = CliRunner().invoke(app, ["bag", str(path), str(tmp_path / "mine"), "--every", "2"])
    assert result.exit_code == 0, result.output
    assert "2 scans in frame base_link, the ground at z -0.2" in result.output
    assert "odometry wheels_odom: 4 m" in result.output
    assert f"skyfix map EXTRACT {tmp_path / 'mine'} --origin 49.010000 8.420000" in result.output


@pytest.mark.parametrize("content", [None, b"", b"#ROSBAG V2.0\nnot really"])
def test_what_is_no_bag_is_one_clear_error(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "drive.bag"
    if content is not None:
        path.write_bytes(content)
    with (
        pytest.raises(SkyfixError, match=r"drive\.bag: (expected a ROS bag|cannot be read as a ROS bag)"),
        open_bag(path),
    ):
        pass


def test_a_folder_without_a_bag_and_a_stump_of_a_file_are_clear_errors(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "stump.mcap").write_bytes(b"\x89MCAP0\r\n")
    for name in ("folder", "stump.mcap"):
        with pytest.raises(SkyfixError, match=f"{name}: cannot be read as a ROS bag"), open_bag(tmp_path / name):
            pass


def test_a_message_that_breaks_off_is_a_clear_error_and_leaves_nothing(tmp_path: Path) -> None:
    types = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(tmp_path / "drive", version=9) as writer:
        connection = writer.add_connection("/points", "sensor_msgs/msg/PointCloud2", typestore=types)
        writer.write(connection, START_NS, b"\x00\x01\x00\x00\x07")
    with open_bag(tmp_path / "drive") as bag, pytest.raises(SkyfixError, match="drive /points: cannot be read"):
        write_bag_folder(bag, tmp_path / "mine", BagRequest())
    assert not (tmp_path / "mine").exists()


@given(
    order=st.permutations(["x", "y", "z", "intensity"]),
    kinds=st.lists(st.sampled_from(["f4", "f8"]), min_size=4, max_size=4),
    gaps=st.lists(st.integers(0, 5), min_size=5, max_size=5),
    big_endian=st.booleans(),
    padding=st.integers(0, 9),
    height=st.sampled_from([1, 2, 3]),
)
def test_any_layout_of_a_cloud_reads_the_same(
    order: list[str], kinds: list[str], gaps: list[int], big_endian: bool, padding: int, height: int
) -> None:
    layout, at = {}, 0
    for name, kind, gap in zip(order, kinds, gaps, strict=False):
        layout[name] = (kind, at + gap)
        at += gap + int(kind[1])
    points = np.random.default_rng(0).uniform(0, 1, (6, 4)).astype(np.float32)
    message = cloud_message(
        points, _Cloud, _Field, None, layout, big_endian, step=at + gaps[4], padding=padding, height=height
    )
    np.testing.assert_array_equal(points_of_message(message, "scan"), points)


def test_broken_clouds_are_refused() -> None:
    good = cloud_message(scan(0), _Cloud, _Field, None)
    for change, message in (
        ({"fields": good.fields[1:]}, "expected fields x, y, z, got y, z, intensity, ring"),
        ({"data": good.data[:-9]}, "bytes, got"),
        ({"point_step": 10}, "within 10 bytes"),
        ({"row_step": 3}, "within 22 bytes"),
        ({"fields": [_Field("x", 0, 99, 1), *good.fields[1:]]}, "of known types"),
    ):
        with pytest.raises(ScanError, match=message):
            points_of_message(SimpleNamespace(**{**vars(good), **change}), "scan")


def test_the_ground_is_the_road_not_the_roof_or_the_wall() -> None:
    rng = np.random.default_rng(3)
    road = np.column_stack([rng.uniform(-12, 12, (2000, 2)), rng.normal(-1.6, 0.03, 2000), np.zeros(2000)])
    deck = np.column_stack([rng.uniform(-8, 8, (2500, 2)), np.full(2500, 0.4), np.zeros(2500)])
    both = np.concatenate([road, deck]).astype(np.float32)
    assert estimate_ground_z([both]) == pytest.approx(-1.6, abs=0.02)
    with pytest.raises(SkyfixError, match="--ground-z"):
        estimate_ground_z([both[:50]])


class _Cloud(SimpleNamespace):
    def __init__(self, *values: object) -> None:
        names = ("header", "height", "width", "fields", "is_bigendian", "point_step", "row_step", "data", "is_dense")
        super().__init__(**dict(zip(names, values, strict=True)))


class _Field(SimpleNamespace):
    def __init__(self, name: str, offset: int, datatype: int, count: int) -> None:
        super().__init__(name=name, offset=offset, datatype=datatype, count=count)
