"""`skyfix emulate`: two tables that say what was emulated, the same with the same seed, numbers as in the library."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from made_drive import MadeDrive
from typer.testing import CliRunner

from fusion import TRANSLOCNET_KITTI, EmulatorSettings, SkyfixError
from sequences.cli import app
from sequences.drive import load_drive
from sequences.emulated_run import EmulatedRunSettings, run_emulated
from sequences.folder import FolderSequence


def emulate(*arguments: str) -> str:
    done = CliRunner().invoke(app, ["emulate", *arguments], catch_exceptions=False)
    assert done.exit_code == 0
    return done.stdout


def test_every_row_with_an_emulated_measurement_says_so(made_drive: MadeDrive, tmp_path: Path) -> None:
    files = ("--json", str(tmp_path / "numbers.json"), "--markdown", str(tmp_path / "tables.md"))
    how = ("--particles", "300", "--seed", "5", "--correlation", "0.5", "--measure-every-m", "8")
    printed = emulate(str(made_drive.path), "--odometry", "wheels", *how, *files)
    assert (tmp_path / "tables.md").read_text(encoding="utf-8") == printed
    titles = [
        line for line in printed.splitlines() if line.startswith("made_drive, odometry wheels, seed 5: emulated ")
    ]
    assert len(titles) == 2
    rows = [line.strip("| ").split(" | ") for line in printed.splitlines() if line.startswith("| ")]
    names = [row[0] for row in rows if row[0] != "method"]
    assert len(names) == 12
    assert names[:6] == names[6:]
    assert [name for name in names[:6] if "emulated" not in name] == ["prior", "odometry only"]
    numbers = json.loads((tmp_path / "numbers.json").read_text())
    assert numbers["emulated"].startswith("emulated TransLocNet")
    settings = EmulatedRunSettings(
        TRANSLOCNET_KITTI,
        EmulatorSettings(step_correlation=0.5),
        seed=5,
        particles=300,
        kept_particles=300,
        measure_every_m=8.0,
    )
    drive = load_drive(FolderSequence(made_drive.path), "wheels")
    assert drive.truth is not None
    run = run_emulated(drive.truth, drive.sequence.odometry("wheels"), settings)
    assert numbers["first"] == json.loads(json.dumps(run.metrics))
    assert f"| {run.metrics['filter']['position_error_m']['mean']:.2f} |" in printed
    # Of a calibrated odometry the same start and the same measurements.
    assert numbers["calibrated"]["single_shot"] == numbers["first"]["single_shot"]
    assert numbers["calibrated"]["odometry"] != numbers["first"]["odometry"]


def test_an_odometry_made_from_the_truth_is_called_emulated_too(made_drive: MadeDrive) -> None:
    wheels = made_drive.path / "odometry" / "wheels.tum"
    wheels.rename(wheels.with_name("emulated.tum"))
    printed = emulate(str(made_drive.path), "--particles", "200", "--profile", "fg2", "--measure-every-m", "16")
    assert printed.startswith("made_drive, odometry emulated (emulated from the truth), seed 0: emulated FG2")


def test_bad_input_is_named(made_drive: MadeDrive) -> None:
    path = str(made_drive.path)
    for arguments, message in (
        (("--profile", "nothing"), "--profile: expected one of translocnet, fg2, orienternet, got 'nothing'"),
        (("--correlation", "1"), "step_correlation: expected in "),
        (("--measure-every-m", "-1"), "measure_every_m: expected 0 or more, got -1"),
        (("--odometry", "none"), "none"),
    ):
        with pytest.raises(SkyfixError, match=message):
            CliRunner().invoke(app, ["emulate", path, *arguments], catch_exceptions=False)
    (made_drive.path / "ground_truth.tum").unlink()
    with pytest.raises(SkyfixError, match="expected ground truth to draw measurements about, found none"):
        CliRunner().invoke(app, ["emulate", path], catch_exceptions=False)
