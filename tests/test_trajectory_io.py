"""TUM files: exact stamps, yaw from any quaternion, and errors that name file and line."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fusion import se2
from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from sequences.trajectory_io import format_seconds, read_times, read_tum, write_tum

STAMPS = st.lists(st.integers(-(2**61), 2**61), min_size=1, max_size=6, unique=True).map(sorted)
COORDINATE = st.floats(-1e6, 1e6)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(stamps=STAMPS, seed=st.integers(0, 1000))
def test_a_trajectory_survives_writing_and_reading(tmp_path: Path, stamps: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = np.column_stack([rng.uniform(-1e5, 1e5, (len(stamps), 2)), rng.uniform(-np.pi, np.pi, len(stamps))])
    trajectory = Trajectory(np.array(stamps, dtype=np.int64), poses, None, "map")
    write_tum(tmp_path / "t.tum", trajectory)
    back = read_tum(tmp_path / "t.tum")
    np.testing.assert_array_equal(back.stamp_ns, trajectory.stamp_ns)
    np.testing.assert_allclose(back.poses[:, :2], poses[:, :2], atol=1e-9)
    np.testing.assert_allclose(se2.wrap(back.poses[:, 2] - trajectory.poses[:, 2]), 0.0, atol=1e-11)


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("1305031102.175304001", 1305031102175304001),
        ("0.1", 100_000_000),
        ("1.305031102175304001e9", 1305031102175304001),
        ("0.0000000004", 0),
        ("0.0000000006", 1),
        ("-1.5", -1_500_000_000),
    ],
)
def test_seconds_become_the_nearest_nanosecond(tmp_path: Path, text: str, stamp_ns: int) -> None:
    (tmp_path / "t.tum").write_text(f"{text} 0 0 0 0 0 0 1\n")
    assert read_tum(tmp_path / "t.tum").stamp_ns.tolist() == [stamp_ns]


@given(st.integers(-(2**62), 2**62))
def test_seconds_are_written_exactly(stamp_ns: int) -> None:
    whole, fraction = format_seconds(stamp_ns).lstrip("-").split(".")
    assert int(whole) * 10**9 + int(fraction) == abs(stamp_ns)
    assert format_seconds(stamp_ns).startswith("-") == (stamp_ns < 0)


@given(yaw=st.floats(-3.1, 3.1), scale=st.floats(0.1, 10.0), sign=st.sampled_from([-1.0, 1.0]))
def test_yaw_comes_from_a_quaternion_of_any_length_and_sign(yaw: float, scale: float, sign: float) -> None:
    x, y, z, w = (value * scale * sign for value in (0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)))
    with TemporaryDirectory() as folder:
        file = Path(folder) / "t.tum"
        file.write_text(f"0 1 2 3 {x} {y} {z} {w}\n")
        assert read_tum(file).poses[0, 2] == pytest.approx(yaw, abs=1e-9)


def test_yaw_of_a_tilted_vehicle_is_that_of_its_nose(tmp_path: Path) -> None:
    # Yaw 0.7 about z, then pitch 0.2 about the new y: the nose's direction on the ground stays 0.7.
    c, s, cp, sp = np.cos(0.35), np.sin(0.35), np.cos(0.1), np.sin(0.1)
    x, y, z, w = -s * sp, c * sp, s * cp, c * cp
    (tmp_path / "t.tum").write_text(f"0 1 2 3 {x} {y} {z} {w}\n")
    np.testing.assert_allclose(read_tum(tmp_path / "t.tum").poses, [[1.0, 2.0, 0.7]], atol=1e-12)


def test_comments_and_blank_lines_are_passed_over(tmp_path: Path) -> None:
    (tmp_path / "t.tum").write_text("# t x y z qx qy qz qw\n\n0 1 2 0 0 0 0 1  # first\n  \n1 3 4 0 0 0 0 1\n")
    assert read_tum(tmp_path / "t.tum").poses[:, 0].tolist() == [1.0, 3.0]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "expected at least one pose"),
        ("# only a comment\n", "expected at least one pose"),
        ("0 1 2 0 0 0 1\n", "line 1: expected 8 numbers (t x y z qx qy qz qw), got 7"),
        ("0 1 2 0 0 0 0 1\n1 1 2 0 0 0 0 x\n", "line 2: expected a number, got 'x'"),
        ("0 nan 2 0 0 0 0 1\n", "line 1: expected a finite number, got nan"),
        ("inf 1 2 0 0 0 0 1\n", "line 1: expected a finite number, got inf"),
        ("0 1 2 0 0 0 0 0\n", "line 1: expected a unit quaternion"),
        ("1 1 2 0 0 0 0 1\n0.5 1 2 0 0 0 0 1\n", "line 2: stamps must increase, got 0.5 s after 1.000000000 s"),
        ("1 1 2 0 0 0 0 1\n1 1 2 0 0 0 0 1\n", "line 2: stamps must increase"),
    ],
)
def test_bad_lines_are_named(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "t.tum").write_text(content)
    with pytest.raises(SkyfixError, match=r"t\.tum") as caught:
        read_tum(tmp_path / "t.tum")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(SkyfixError, match="cannot be read: No such file"):
        read_tum(tmp_path / "none.tum")
    (tmp_path / "binary.tum").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(SkyfixError, match="not a text file"):
        read_tum(tmp_path / "binary.tum")


def test_times_are_read_one_a_line(tmp_path: Path) -> None:
    (tmp_path / "times.txt").write_text("0.000000\n1.037360e-01\n0.2\n")
    assert read_times(tmp_path / "times.txt").tolist() == [0, 103_736_000, 200_000_000]
    (tmp_path / "times.txt").write_text("0.1 0.2\n")
    with pytest.raises(SkyfixError, match="expected one number"):
        read_times(tmp_path / "times.txt")


def test_nanoseconds_where_seconds_belong_are_told(tmp_path: Path) -> None:
    (tmp_path / "epoch.tum").write_text("1700000000000000000 0 0 0 0 0 0 1\n")
    (tmp_path / "times.txt").write_text("1700000000000000000\n")
    for read, name in ((read_tum, "epoch.tum"), (read_times, "times.txt")):
        with pytest.raises(SkyfixError, match=f"{name}: line 1: expected seconds up to 9.2e9, not nanoseconds, got 17"):
            read(tmp_path / name)
