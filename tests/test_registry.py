"""Every layout is opened by its path alone, converted to the folder format, and refused in one line when broken."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import carla_layout
import numpy as np
import pytest
from kitti_layout import DATE, DRIVE, FRAMES, write_folder_map, write_odometry_sequence, write_osm, write_raw
from made_drive import EmulatedMatcher, MadeDrive
from test_kitti_crossview import write_crossview

import learned.matcher
import sequences.localize
import sequences.registry
from fusion.errors import SkyfixError
from sequences.cli import main
from sequences.folder import FolderSequence
from sequences.frame_set import FrameSet
from sequences.registry import OpenOptions, Reader, open_any, open_sequence
from sequences.sequence import Sequence


def kitti(root: Path) -> Path:
    drive = write_raw(root)
    write_folder_map(drive)
    return drive


WRITERS: dict[str, Callable[[Path], Path]] = {
    "kitti": kitti,
    "kitti_odometry": write_odometry_sequence,
    "kitti_crossview": write_crossview,
    "carla": carla_layout.write_route,
}


def skyfix(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: str) -> tuple[object, str]:
    """Exit code and standard error of a command."""
    monkeypatch.setattr(sys, "argv", ["skyfix", *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    return caught.value.code, capsys.readouterr().err


@pytest.mark.parametrize("layout", ["kitti", "kitti_odometry", "carla"])
def test_any_drive_can_be_converted(
    tmp_path: Path, layout: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    source = WRITERS[layout](tmp_path)
    code, errors = skyfix(capsys, monkeypatch, "convert", str(source), str(tmp_path / "out"), "--allow-pickle")
    assert (code, errors) == (0, "")
    original = open_sequence(source, OpenOptions(allow_pickle=True))
    copy = open_sequence(tmp_path / "out")
    assert isinstance(copy, FolderSequence)
    assert copy.map.grid == original.map.grid
    np.testing.assert_array_equal(copy.map.picture, original.map.picture)
    assert (copy.map.classes is None) == (original.map.classes is None)
    np.testing.assert_array_equal(copy.stamps_ns, original.stamps_ns)
    assert (copy.ground_z, copy.scans_simulated) == (original.ground_z, False)
    assert copy.odometry_names == original.odometry_names != ()
    for name in original.odometry_names:
        np.testing.assert_allclose(copy.odometry(name).poses, original.odometry(name).poses, atol=1e-8)
    assert copy.ground_truth is not None
    assert original.ground_truth is not None
    np.testing.assert_array_equal(copy.ground_truth.stamp_ns, original.ground_truth.stamp_ns)
    np.testing.assert_allclose(copy.ground_truth.poses, original.ground_truth.poses, atol=1e-8)
    for index in range(len(original.stamps_ns)):
        np.testing.assert_array_equal(copy.scan(index), original.scan(index))
    code, errors = skyfix(capsys, monkeypatch, "convert", str(source), str(tmp_path / "out"), "--allow-pickle")
    assert code == 2
    assert errors.endswith("out: expected a new or empty folder\n")


@pytest.mark.parametrize("layout", ["kitti", "kitti_odometry", "carla"])
def test_track_opens_any_drive(
    tmp_path: Path, layout: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Sequence] = []

    def stop(sequence: Sequence, *_: object) -> None:
        opened.append(sequence)
        raise SkyfixError("that will do")

    monkeypatch.setattr(
        learned.matcher, "load_matcher", lambda name, backend=None: EmulatedMatcher(np.zeros((FRAMES, 3)))
    )
    monkeypatch.setattr(sequences.localize, "track", stop)
    arguments = ["track", str(WRITERS[layout](tmp_path)), "--out", str(tmp_path / "run"), "--allow-pickle", "--quiet"]
    assert skyfix(capsys, monkeypatch, *arguments) == (2, "skyfix: error: that will do\n")
    assert layout.split("_")[0] in type(opened[0]).__name__.lower()


@pytest.mark.parametrize("layout", list(WRITERS))
def test_evaluate_opens_everything(
    tmp_path: Path, layout: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = WRITERS[layout](tmp_path)
    opened = open_any(path, OpenOptions(allow_pickle=True))
    if isinstance(opened, FrameSet):
        truth = np.array([opened.frame(index).true_pose for index in range(len(opened))])
    else:
        assert opened.ground_truth is not None
        truth = opened.ground_truth.interpolate(opened.stamps_ns)
    monkeypatch.setattr(learned.matcher, "load_matcher", lambda name, backend=None: EmulatedMatcher(truth))
    arguments = ["evaluate", str(path), "--matcher", "x", "--json", str(tmp_path / "x.json"), "--allow-pickle"]
    assert skyfix(capsys, monkeypatch, *arguments) == (0, "")
    (result,) = json.loads((tmp_path / "x.json").read_text())
    assert result["sequence"] == opened.name
    assert result["methods"]["x"]["position_error_m"]["mean"] < 1.5
    assert result["methods"]["prior"]["position_error_m"]["mean"] > 5.0


def unlink(name: str) -> Callable[[Path], object]:
    return lambda path: (path / name).unlink()


def write(name: str, text: str) -> Callable[[Path], object]:
    return lambda path: (path / name).write_text(text)


def empty(name: str) -> Callable[[Path], object]:
    return lambda path: [file.unlink() for file in (path / name).iterdir()]


LAST = "0000000011"
RECORD = f"oxts/data/{LAST}.txt"
IMAGE = f"satmap/{DATE}/{DRIVE}/0000000000.png"
FIRST_RECORD = f"raw_data/{DATE}/{DRIVE}/oxts/data/0000000000.txt"
SPOILS: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "no records": ("kitti", empty("oxts/data"), "data: expected oxts records NNNNNNNNNN.txt, got none"),
    "record cut": ("kitti", write(RECORD, "49 8 100\n"), f"{LAST}.txt: line 1: expected 30 numbers, got 3"),
    "record no number": ("kitti", write(RECORD, "x " * 30), f"{LAST}.txt: line 1: expected 30 numbers, could not"),
    "record with NaN": ("kitti", write(RECORD, "nan " * 30), f"{LAST}.txt: line 1: expected finite numbers"),
    "record twice": ("kitti", write(RECORD, ("0 " * 30 + "\n") * 2), f"{LAST}.txt: expected one record"),
    "record elsewhere": ("kitti", write(RECORD, "99 " * 30), f"{LAST}.txt: expected one record that begins with"),
    "record empty": ("kitti", write(RECORD, ""), f"{LAST}.txt: expected lines of 30 numbers, got an empty file"),
    "record misnamed": ("kitti", write("oxts/data/x.txt", ""), "x.txt: expected a file named by a frame's number"),
    "no record times": ("kitti", unlink("oxts/timestamps.txt"), "timestamps.txt: cannot be read: No such file"),
    "few record times": (
        "kitti",
        write("oxts/timestamps.txt", "2011-09-26 13:02:25.9\n"),
        "timestamps.txt: expected a line for each of 12 records, got 1",
    ),
    "times go back": (
        "kitti",
        write("oxts/timestamps.txt", "2011-09-26 13:02:25.9\n2011-09-26 13:02:25.8\n"),
        "line 2: stamps must increase",
    ),
    "no time": ("kitti", write("oxts/timestamps.txt", "noon\n"), "line 1: expected a date and a time, got 'noon'"),
    "no such month": ("kitti", write("oxts/timestamps.txt", "2011-13-26 13:02:25\n"), "expected a date and a time"),
    "times binary": (
        "kitti",
        lambda path: (path / "oxts/timestamps.txt").write_bytes(b"\xff\xfe"),
        "timestamps.txt: cannot be read: not a text file",
    ),
    "no scan times": ("kitti", unlink("velodyne_points/timestamps.txt"), "timestamps.txt: cannot be read"),
    "few scan times": (
        "kitti",
        write("velodyne_points/timestamps.txt", "2011-09-26 13:02:25.9\n"),
        f"expected a line for {LAST}.bin, got 1 lines",
    ),
    "no scans": ("kitti", empty("velodyne_points/data"), "data: expected scans NNNNNNNNNN.bin, got none"),
    "no calibration": ("kitti", unlink("../calib_imu_to_velo.txt"), "calib_imu_to_velo.txt: cannot be read"),
    "calibration without T": (
        "kitti",
        write("../calib_imu_to_velo.txt", "R: 1 0 0 0 1 0 0 0 1\n"),
        "calib_imu_to_velo.txt: expected a line 'T', got R",
    ),
    "calibration short": ("kitti", write("../calib_imu_to_velo.txt", "R: 1 0 0\nT: 1 2 3\n"), "9 numbers and a tran"),
    "calibration no rotation": (
        "kitti",
        write("../calib_imu_to_velo.txt", "R: 1 0 0 0 1 0 0 0 2\nT: 1 2 3\n"),
        "calib_imu_to_velo.txt: expected a rotation matrix",
    ),
    "no map": ("kitti", lambda path: shutil.rmtree(path / "map"), "map: expected map/map.json or an OpenStreetMap"),
    "map without origin": (
        "kitti",
        lambda path: (shutil.rmtree(path / "map"), write_folder_map(path, None)),
        "map.json: origin_lat_lon_alt: expected two or three numbers, got None",
    ),
    "two extracts": (
        "kitti",
        lambda path: (shutil.rmtree(path / "map"), write_osm(path / "a.osm"), write_osm(path / "b.osm")),
        "expected one map extract, got a.osm, b.osm",
    ),
    "extract broken": (
        "kitti",
        lambda path: (shutil.rmtree(path / "map"), (path / "a.osm").write_text("<osm")),
        "map extract: expected OpenStreetMap data",
    ),
    "fixes far apart": (
        "kitti",
        lambda path: (
            shutil.rmtree(path / "map"),
            write_osm(path / "a.osm"),
            (path / RECORD).write_text("48 8 " + "0 " * 28),
        ),
        "map: expected a drive within 20000 m",
    ),
    "odometry: scan missing": ("kitti_odometry", unlink("velodyne/000003.bin"), "expected 12 scans, one a line of"),
    "odometry: no map": ("kitti_odometry", unlink("map/map.json"), "map.json: cannot be read"),
    "odometry: no Tr": ("kitti_odometry", write("calib.txt", "P0: 1\n"), "calib.txt: expected a line 'Tr', got P0"),
    "odometry: Tr short": (
        "kitti_odometry",
        write("calib.txt", "Tr: 1\n"),
        "calib.txt: Tr: expected 12 numbers, got 1",
    ),
    "odometry: pose short": (
        "kitti_odometry",
        write("../../poses/00.txt", "1 2\n"),
        "line 1: expected 12 numbers, got 2",
    ),
    "odometry: poses missing": (
        "kitti_odometry",
        write("../../poses/00.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n"),
        "00.txt: expected 12 poses, one a scan, got 1",
    ),
    "odometry: placed nowhere": (
        "kitti_odometry",
        write("map_from_first.json", '{"x": 1}'),
        "map_from_first.json: y: expected a finite number, got None",
    ),
    "carla: no measurement": ("carla", unlink("measurements/0002.json"), "0002.json: cannot be read: No such file"),
    "carla: measurement broken": ("carla", write("measurements/0002.json", "{"), "0002.json: expected JSON"),
    "carla: no theta": (
        "carla",
        write("measurements/0002.json", '{"x": 1, "y": 2}'),
        "theta: expected a finite number",
    ),
    "carla: no photograph": ("carla", unlink("topdown_rgb/0003.png"), "0003.png: cannot be read: No such file"),
    "carla: photograph broken": ("carla", write("topdown_rgb/0003.png", "x"), "cannot be read: not a readable image"),
    "carla: dump broken": ("carla", write("dump_gt.json", "[]"), "dump_gt.json: expected a JSON object, got a list"),
    "carla: dump empty": (
        "carla",
        write("dump_gt.json", '{"0003": {}}'),
        "expected scans lidar/NNNN.npy on photograph",
    ),
    "carla: nothing": (
        "carla",
        lambda path: (unlink("dump_gt.json")(path), unlink("topdown_rgb/0003.png")(path)),
        "topdown_rgb: expected a photograph NNNN.png, got none",
    ),
    "list: broken": (
        "kitti_crossview",
        write("test1.txt", "a b\n"),
        "test1.txt: line 1: expected DATE/DRIVE/FRAME.png",
    ),
    "list: no satmap": ("kitti_crossview", lambda p: shutil.rmtree(p / "satmap"), "expected satmap/ beside test1.txt"),
    "list: no image": ("kitti_crossview", unlink(IMAGE), "0000000000.png: cannot be read: No such file"),
    "list: image broken": (
        "kitti_crossview",
        write(IMAGE, "x"),
        "0000000000.png: cannot be read: not a readable image",
    ),
    "list: no record": ("kitti_crossview", unlink(FIRST_RECORD), "0000000000.txt: cannot be read: No such file"),
}


@pytest.mark.parametrize("case", list(SPOILS))
def test_what_is_broken_is_refused_in_one_line(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    layout, spoil, message = SPOILS[case]
    path = WRITERS[layout](tmp_path)
    spoil(path.parent if path.is_file() else path)
    monkeypatch.setattr(
        learned.matcher, "load_matcher", lambda name, backend=None: EmulatedMatcher(np.zeros((FRAMES, 3)))
    )
    command = "evaluate" if layout == "kitti_crossview" else "track"
    code, errors = skyfix(capsys, monkeypatch, command, str(path), "--allow-pickle")
    assert code == 2
    assert errors.startswith("skyfix: error: ")
    assert errors.count("\n") == 1
    assert message in errors
    assert not (tmp_path / "runs").exists()


def test_pickles_need_the_option(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = str(carla_layout.write_route(tmp_path))
    for arguments in (["track", path], ["evaluate", path, "--matcher", "geometric"], ["convert", path, path + "x"]):
        code, errors = skyfix(capsys, monkeypatch, *arguments)
        assert code == 2
        assert "0000.npy: expected a plain array, got pickled objects" in errors
        assert errors.count("\n") == 1


@pytest.mark.parametrize("command", ["track", "convert"])
def test_lists_of_frames_are_no_drives(
    tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = str(write_crossview(tmp_path))
    code, errors = skyfix(
        capsys, monkeypatch, command, path, *([str(tmp_path / "out")] if command == "convert" else [])
    )
    assert code == 2
    assert "expected a drive, got single frames with a map each; `skyfix evaluate` takes them" in errors


def installed(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    """Make as if a package with such an entry point were there."""
    point = EntryPoint("mine", value, sequences.registry.GROUP)
    monkeypatch.setattr(sequences.registry, "entry_points", lambda group: EntryPoints([point]).select(group=group))


def test_another_package_can_add_a_reader(made_drive: MadeDrive, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[OpenOptions] = []

    def open_mine(path: Path, options: OpenOptions) -> Sequence:
        asked.append(options)
        return FolderSequence(made_drive.path)

    mine = Reader("mine", lambda path: path.suffix == ".mine", open_mine)
    monkeypatch.setattr(sys.modules[__name__], "MINE", mine, raising=False)
    installed(monkeypatch, f"{__name__}:MINE")
    assert open_sequence(Path("x.mine"), OpenOptions(7)).name == "made_drive"
    assert asked == [OpenOptions(7)]
    assert open_sequence(made_drive.path).name == "made_drive"


@pytest.mark.parametrize(
    ("value", "message"),
    [("no_such_module:X", "cannot be loaded from no_such_module:X"), ("json:loads", "expected a Reader at json:loads")],
)
def test_a_reader_that_is_none_is_named(monkeypatch: pytest.MonkeyPatch, value: str, message: str) -> None:
    installed(monkeypatch, value)
    with pytest.raises(SkyfixError, match=f"reader 'mine': {message}"):
        open_any(Path("anything"))


def test_what_nobody_recognises_is_told_what_was_expected(tmp_path: Path) -> None:
    with pytest.raises(SkyfixError, match="expected a sequence folder"):
        open_any(tmp_path / "none")
    with pytest.raises(SkyfixError, match=r"map\.json: cannot be read"):
        open_any(tmp_path)
