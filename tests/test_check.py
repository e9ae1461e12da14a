"""`skyfix check`: each of the usual mistakes is found in a drive that has it, and none in one that has not."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import skyfix
from made_drive import GROUND_Z, EmulatedMatcher, MadeDrive

import learned.matcher
from fusion import se2
from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from sequences.check import Finding, Level, check
from sequences.folder import FolderSequence
from sequences.trajectory_io import format_seconds, write_tum

Spoil = Callable[[MadeDrive], None]


def with_ground(made: MadeDrive, z: float) -> None:
    """Scans of a flat road, 20 m to all sides, that know their own number as the made ones do."""
    for index in range(len(made.truth)):
        points = np.random.default_rng(index).uniform(-20.0, 20.0, size=(2000, 4)).astype(np.float32)
        points[:, 2], points[:, 3] = z, index / 1000.0
        points.tofile(made.scan_file(index))


@pytest.fixture
def made(made_drive: MadeDrive) -> MadeDrive:
    with_ground(made_drive, GROUND_Z)
    return made_drive


def rewritten(change: Callable[[Trajectory], Trajectory], *, truth: bool = False) -> Spoil:
    def spoil(made: MadeDrive) -> None:
        name, trajectory = ("ground_truth", made.truth) if truth else ("odometry/wheels", made.odometry)
        write_tum(made.path / f"{name}.tum", change(trajectory))

    return spoil


def moved(transform: Callable[[np.ndarray], np.ndarray]) -> Callable[[Trajectory], Trajectory]:
    return lambda trajectory: replace(trajectory, poses=transform(trajectory.poses.copy()))


def without_most_scans(made: MadeDrive) -> None:
    for index in range(8, len(made.truth)):
        made.scan_file(index).write_bytes(b"")


def other_stamps(made: MadeDrive) -> None:
    times = "".join(f"{format_seconds(int(stamp) - 10**18)}\n" for stamp in made.truth.stamp_ns)
    (made.path / "scans" / "times.txt").write_text(times)


def told(made: MadeDrive) -> list[Finding]:
    return check(FolderSequence(made.path), EmulatedMatcher(made.truth.poses))


def test_a_drive_in_which_all_fits(made: MadeDrive) -> None:
    findings = told(made)
    assert {finding.level for finding in findings} == {Level.OK}
    subjects = [finding.subject for finding in findings]
    assert subjects == ["scans", "scans", "ground", "map", "ground truth", *["odometry wheels"] * 2, "matching"]
    text = " | ".join(finding.text for finding in findings)
    assert "30 (measured) over 5.8 s, one every 0.2 s" in text
    assert f"said to be at z = {GROUND_Z:.2f} m, in the scans at -1.7" in text
    assert "58 m, at 100 % of the scans, 100 % of it on the map" in text
    assert "1.030 of the true length; begun at the true pose 1.2 m off on average" in text
    assert "8 scans matched by emulated from ±20 m, ±10°: median 0." in text
    assert "100 % within 3 m" in text


PROBLEMS: dict[str, tuple[Spoil, str, str]] = {
    "sensor's height": (
        lambda made: (made.path / "sensor.json").write_text(json.dumps({"ground_z": 0.0})) and None,
        "ground",
        "said to be at z = 0.00 m, in the scans at -1.7",
    ),
    "no scan": (
        lambda made: [made.scan_file(i).write_bytes(b"") for i in range(30)] and None,
        "scans",
        "8 of 8 not usable",
    ),
    "odometry in feet": (
        rewritten(moved(lambda poses: poses * [3.281, 3.281, 1.0])),
        "odometry wheels",
        "3.379 of the true length",
    ),
    "odometry's y to the right": (
        rewritten(moved(lambda poses: poses * [1.0, -1.0, -1.0])),
        "odometry wheels",
        "turns the other way than the truth",
    ),
    "odometry's x to the left": (
        rewritten(moved(lambda poses: se2.compose(poses, np.array([0.0, 0.0, np.pi / 2])))),
        "odometry wheels",
        "got one that moves along -y",
    ),
    "odometry backwards": (
        rewritten(moved(lambda poses: se2.compose(poses, np.array([0.0, 0.0, np.pi])))),
        "odometry wheels",
        "degrees off its heading: expected x forward",
    ),
    "headings of a compass": (
        rewritten(moved(lambda poses: poses * [1.0, 1.0, 60.0])),
        "odometry wheels",
        "headings do not follow the path",
    ),
    "odometry of another clock": (
        rewritten(lambda one: Trajectory(one.stamp_ns - 10**18, one.poses)),
        "odometry wheels",
        "expected an overlap in time with the scans",
    ),
    "odometry in centimetres": (
        rewritten(moved(lambda poses: poses * [100.0, 100.0, 1.0])),
        "odometry wheels",
        "is it in metres, its times in seconds?",
    ),
    "truth of another map": (
        rewritten(moved(lambda poses: poses + [5000.0, 0.0, 0.0]), truth=True),
        "ground truth",
        "0 % of it on the map",
    ),
    "truth in compass headings": (
        rewritten(moved(lambda poses: np.column_stack([poses[:, :2], np.pi / 2 - poses[:, 2]])), truth=True),
        "ground truth",
        "headings do not follow the path",
    ),
    "truth that stands still": (
        rewritten(moved(lambda poses: 0.0 * poses), truth=True),
        "odometry wheels",
        "59.7 m where the truth is 0.0 m long",
    ),
    "scans of another clock": (other_stamps, "odometry wheels", "expected an overlap in time"),
}


@pytest.mark.parametrize("mistake", PROBLEMS)
def test_a_mistake_is_named(made: MadeDrive, mistake: str) -> None:
    spoil, subject, text = PROBLEMS[mistake]
    spoil(made)
    problems = [finding for finding in told(made) if finding.level is Level.PROBLEM]
    assert any(finding.subject == subject and text in finding.text for finding in problems), problems


def test_a_map_of_another_place_shows_in_the_matching(made: MadeDrive) -> None:
    matcher = EmulatedMatcher(made.truth.poses + [12.0, -9.0, 0.0])
    (problem,) = [one for one in check(FolderSequence(made.path), matcher) if one.level is Level.PROBLEM]
    assert problem.subject == "matching"
    assert "0 % within 3 m" in problem.text


def test_what_may_be_meant_is_a_note(made: MadeDrive) -> None:
    without_most_scans(made)
    (made.path / "ground_truth.tum").unlink()
    rewritten(lambda one: Trajectory(one.stamp_ns[:20], one.poses[:20]))(made)
    notes = {finding.subject: finding.text for finding in told(made) if finding.level is Level.NOTE}
    assert set(notes) == {"scans", "ground truth", "odometry wheels"}
    assert notes["scans"].startswith("6 of 8 not usable: ")
    assert notes["odometry wheels"].endswith("at 67 % of the scans")
    assert "matching" not in {finding.subject for finding in told(made)}


def test_the_command_prints_all_and_draws(
    made: MadeDrive, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learned.matcher, "load_matcher", lambda *_: EmulatedMatcher(made.truth.poses))
    picture = tmp_path / "check.png"
    finished = skyfix(capsys, monkeypatch, "check", str(made.path), "--picture", str(picture))
    assert (finished.code, finished.err) == (0, "")
    lines = finished.out.splitlines()
    assert lines[:-1] == [f"{one.level:<8} {one.subject}: {one.text}" for one in told(made)]
    assert picture.read_bytes().startswith(b"\x89PNG")
    PROBLEMS["odometry of another clock"][0](made)
    finished = skyfix(capsys, monkeypatch, "check", str(made.path), "--picture", str(picture))
    assert (finished.code, finished.err) == (1, "")
    write_tum(made.path / "odometry" / "wheels.tum", made.odometry)
    (made.path / "ground_truth.tum").unlink()
    finished = skyfix(capsys, monkeypatch, "check", str(made.path), "--picture", str(picture))
    assert finished.code == 0
    PROBLEMS["odometry backwards"][0](made)
    assert skyfix(capsys, monkeypatch, "check", str(made.path)).code == 1
    finished = skyfix(capsys, monkeypatch, "check", str(made.path), "--picture", str(tmp_path / "none" / "x.png"))
    assert finished.code == 2
    assert "cannot be written" in finished.err


def test_what_is_no_drive_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SkyfixError, match="expected a sequence folder"):
        check(FolderSequence(tmp_path / "none"))
