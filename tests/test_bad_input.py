"""Bad input to the command line: one clear line on standard error, exit code 2, and no half-written run directory."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_drive import EmulatedMatcher, MadeDrive, made_scan

import learned.matcher
from sequences.cli import main

Spoil = Callable[[MadeDrive], object]


def edit_lines(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")


def swap(path: Path, first: int, second: int) -> None:
    """Swap two lines, so that the stamps go back."""

    def swapped(lines: list[str]) -> list[str]:
        lines[first], lines[second] = lines[second], lines[first]
        return lines

    edit_lines(path, swapped)


def shift_stamps(path: Path, seconds: int) -> None:
    def shifted(lines: list[str]) -> list[str]:
        stamps, rest = zip(*(line.split(" ", 1) for line in lines), strict=True)
        whole = [(int(stamp.split(".")[0]) + seconds, stamp.split(".")[1]) for stamp in stamps]
        return [f"{second}.{fraction} {tail}" for (second, fraction), tail in zip(whole, rest, strict=True)]

    edit_lines(path, shifted)


def with_nan(made: MadeDrive) -> None:
    points = made_scan(0)
    points[0, 0] = np.nan
    points.tofile(made.scan_file(0))


def rename_class(made: MadeDrive) -> None:
    description = json.loads((made.path / "map.json").read_text())
    description["layers"][0]["classes"] = ["grass", "moon dust"]
    (made.path / "map.json").write_text(json.dumps(description))


def truth(made: MadeDrive) -> Path:
    return made.path / "ground_truth.tum"


def wheels(made: MadeDrive) -> Path:
    return made.path / "odometry" / "wheels.tum"


def times(made: MadeDrive) -> Path:
    return made.path / "scans" / "times.txt"


def in_place_of(path: Path) -> None:
    """Put a folder where a file should be: it exists and cannot be read, for any user."""
    path.unlink()
    path.mkdir()


SPOILS: dict[str, tuple[Spoil, str]] = {
    "no folder": (lambda made: shutil.rmtree(made.path), "expected a sequence folder"),
    "no map": (lambda made: (made.path / "map.json").unlink(), "map.json: cannot be read: No such file"),
    "no layer": (lambda made: (made.path / "semantic.png").unlink(), "semantic.png: cannot be read: No such file"),
    "map is no JSON": (lambda made: (made.path / "map.json").write_text("{"), "map.json: expected JSON"),
    "unknown class": (rename_class, "map class 'moon dust': unknown; known are"),
    "truth unreadable": (lambda made: in_place_of(truth(made)), "ground_truth.tum: cannot be read: Is a directory"),
    "truth goes back": (lambda made: swap(truth(made), 4, 5), "ground_truth.tum: line 6: stamps must increase"),
    "odometry unreadable": (lambda made: in_place_of(wheels(made)), "wheels.tum: cannot be read: Is a directory"),
    "odometry goes back": (lambda made: swap(wheels(made), 7, 8), "wheels.tum: line 9: stamps must increase"),
    "odometry without overlap": (
        lambda made: shift_stamps(wheels(made), 3600),
        "odometry 'wheels': expected an overlap in time with the scans (1700000000.000000001 ..",
    ),
    "truth without overlap": (
        lambda made: shift_stamps(truth(made), -3600),
        "ground truth: expected an overlap in time",
    ),
    "no odometry": (lambda made: shutil.rmtree(made.path / "odometry"), "has no odometry"),
    "times go back": (lambda made: swap(times(made), 2, 3), "times.txt: line 4: stamps must increase"),
    "no times": (lambda made: times(made).unlink(), "times.txt: cannot be read: No such file"),
    "a scan missing": (lambda made: made.scan_file(11).unlink(), "000011.bin is missing (1 in all)"),
    "more scans than times": (
        lambda made: made_scan(30).tofile(made.scan_file(30)),
        "scans: expected 30 files, one a line of times.txt, got 31",
    ),
    "first scan too short": (
        lambda made: made.scan_file(0).write_bytes(bytes(50)),
        "scan 000000.bin: expected a multiple of 16 bytes (float32 x, y, z, reflectance), got 50",
    ),
    "first scan empty": (lambda made: made.scan_file(0).write_bytes(b""), "scan 000000.bin: expected points, got none"),
    "first scan with NaN": (with_nan, "scan 000000.bin: expected finite points, got 1 of 200"),
    "first scan unreadable": (lambda made: in_place_of(made.scan_file(0)), "scan 000000.bin: cannot be read"),
    "no ground height": (lambda made: (made.path / "sensor.json").unlink(), "sensor.json: cannot be read"),
    "no truth and no start": (
        lambda made: truth(made).unlink(),
        "has no ground truth to draw a start from: give --start",
    ),
}

OPTIONS: dict[str, tuple[list[str], str]] = {
    "start off the map": (["--start", "5000", "0", "0"], "start: expected inside the map, x -60 .. 60 m"),
    "start not finite": (["--start", "nan", "0", "0"], "start: expected a finite number"),
    "unknown odometry": (["--odometry", "sonar"], "odometry 'sonar': unknown for made_drive; there are: wheels"),
    "unknown matcher": (
        ["--matcher", "tea-leaves"],
        "matcher: expected 'rotmatch', 'pooled', 'geometric', FILE.py:NAME, a .safetensors file or",
    ),
    "no particles": (["--particles", "0"], "particles: expected more than 0"),
    "heading too wide": (["--half-heading-deg", "270"], "half_heading_deg: expected at most 180"),
}


@pytest.fixture
def emulated(monkeypatch: pytest.MonkeyPatch, made_drive: MadeDrive) -> None:
    """Let the command line load the emulated matcher for 'emulated', and what it would have loaded otherwise."""
    load = learned.matcher.load_matcher
    matcher = EmulatedMatcher(made_drive.truth.poses)
    monkeypatch.setattr(
        learned.matcher, "load_matcher", lambda name, *rest: matcher if name == "emulated" else load(name, *rest)
    )


def complaint(arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    """Run skyfix, require exit code 2 and a single line on standard error, and return that line."""
    monkeypatch.setattr(sys, "argv", ["skyfix", *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    printed = capsys.readouterr()
    assert caught.value.code == 2
    assert printed.out == ""
    lines = printed.err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("skyfix: error: ")
    return lines[0]


@pytest.mark.usefixtures("emulated")
@pytest.mark.parametrize("name", SPOILS)
def test_spoilt_files(
    name: str,
    made_drive: MadeDrive,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    spoil, message = SPOILS[name]
    spoil(made_drive)
    out = tmp_path / "runs" / "one"
    arguments = ["track", str(made_drive.path), "--out", str(out), "--matcher", "emulated"]
    assert message in complaint(arguments, monkeypatch, capsys)
    assert not out.parent.exists()


@pytest.mark.usefixtures("emulated")
@pytest.mark.parametrize("name", OPTIONS)
def test_options_that_cannot_be(
    name: str,
    made_drive: MadeDrive,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    options, message = OPTIONS[name]
    out = tmp_path / "runs" / "one"
    arguments = ["track", str(made_drive.path), "--out", str(out), "--matcher", "emulated", *options]
    assert message in complaint(arguments, monkeypatch, capsys)
    assert not out.parent.exists()


@pytest.mark.usefixtures("emulated")
def test_a_taken_target_is_refused_before_any_work(
    made_drive: MadeDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("years of work")
    made_drive.scan_file(0).write_bytes(b"")  # would be complained about first if tracking had begun
    arguments = ["track", str(made_drive.path), "--matcher", "emulated", "--overwrite", "--out", str(tmp_path / "out")]
    assert "exists and is not a run directory" in complaint(arguments, monkeypatch, capsys)
    assert (tmp_path / "out" / "thesis.tex").read_text() == "years of work"


def test_a_checkpoint_that_is_none(
    made_drive: MadeDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoint = tmp_path / "weights.safetensors"
    arguments = ["track", str(made_drive.path), "--out", str(tmp_path / "out"), "--matcher", str(checkpoint)]
    complaint(arguments, monkeypatch, capsys)  # missing
    checkpoint.write_bytes(b"these are no tensors")
    complaint(arguments, monkeypatch, capsys)
    assert not (tmp_path / "out").exists()


def test_views_and_evaluations_of_what_is_not_there(
    made_drive: MadeDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "expected a run directory" in complaint(["view", str(tmp_path)], monkeypatch, capsys)
    truth(made_drive).unlink()
    arguments = ["evaluate", str(made_drive.path), "--matcher", "geometric"]
    assert "expected ground truth to evaluate against" in complaint(arguments, monkeypatch, capsys)
