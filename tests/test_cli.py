"""The command line: a drive tracked from end to end, its table, its help."""

from __future__ import annotations

import io
import json
import math
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from commands import Finished, skyfix
from made_drive import EmulatedMatcher, MadeDrive, write_made_drive
from rich.console import Console

import learned.matcher
import sequences.demo
import sequences.localize
import sequences.progress
import sequences.train_command
from fusion.errors import SkyfixError
from fusion.odometry_errors import OdometryCalibration
from sequences.cli import app, main
from sequences.cli_track import default_odometry
from sequences.folder import FolderSequence
from sequences.progress import ConsoleProgress
from sequences.run_files import read_calibration
from sequences.run_result import FrameRow
from sequences.tables import ROWS, closing_lines
from sequences.track_settings import TrackSettings
from sequences.train_command import TrainOptions


@dataclass(frozen=True)
class TrackedRun:
    """A run directory that `skyfix track` wrote, and what it printed."""

    made: MadeDrive
    out: Path
    printed: Finished


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> TrackedRun:
    """`skyfix track` with the emulated matcher on a made-up drive, the report included."""
    made = write_made_drive(tmp_path_factory.mktemp("cli") / "made_drive")
    out = made.path.parent / "run"
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(learned.matcher, "load_matcher", lambda *_: EmulatedMatcher(made.truth.poses))
        monkeypatch.setattr(sys, "argv", ["skyfix", "track", str(made.path), "--out", str(out), "--particles", "2000"])
        stdout, stderr = Lines(), Lines()
        monkeypatch.setattr(sys, "stdout", stdout)
        monkeypatch.setattr(sys, "stderr", stderr)
        with pytest.raises(SystemExit) as caught:
            main()
    return TrackedRun(made, out, Finished(caught.value.code, stdout.text, stderr.text))


class Lines:
    """A stream that is not a terminal."""

    encoding = "utf-8"

    def __init__(self) -> None:
        self.text = ""

    def write(self, text: str) -> int:
        self.text += text
        return len(text)

    def flush(self) -> None:
        """Everything is kept already."""

    def isatty(self) -> bool:
        return False


def test_track_writes_a_run_and_prints_its_table(tracked: TrackedRun) -> None:
    assert tracked.printed.code == 0
    metrics = json.loads((tracked.out / "metrics.json").read_text())
    for key, label in ROWS.items():
        shown = label.replace("odometry, ", "↳ ")
        row = next(line for line in tracked.printed.out.splitlines() if line.strip().startswith(shown))
        assert f"{metrics[key]['position_error_m']['mean']:.2f}" in row
    assert str(tracked.out / "report.html") in tracked.printed.out
    assert (tracked.out / "report.html").stat().st_size > 10_000
    assert max(map(len, tracked.printed.out.split("smoother:")[0].splitlines())) <= 80


def test_metrics_have_what_other_programs_read(tracked: TrackedRun) -> None:
    metrics = json.loads((tracked.out / "metrics.json").read_text())
    for method in ("prior", "odometry", "single_shot", "filter", "smoother"):
        summary = metrics[method]
        assert set(summary["position_error_m"]) == {"mean", "median", "rmse", "max"}
        assert set(summary["heading_error_deg"]) == {"mean", "median", "max"}
        for recall in ("lateral_recall", "longitudinal_recall", "heading_recall"):
            assert set(summary[recall]) == {"1", "3", "5"}
            assert all(0.0 <= share <= 1.0 for share in summary[recall].values())
        assert summary["frames"] > 0
    for method in ("filter", "smoother", "filter_after_first_quarter"):
        assert set(metrics[method]["nees"]) == {"mean", "dof", "coverage95"}
        assert 0.0 <= metrics[method]["ellipse95"] <= 1.0
    assert set(metrics["drift"]) == {"first_quarter_mean_m", "last_quarter_mean_m", "odometry_final_error_m"}
    assert "single_shot_correlation_length_m" in metrics
    assert metrics["odometry_source"] == "wheels"
    assert set(metrics["seconds_per_frame"]) == {"scan", "match", "predict", "update", "smooth"}
    assert metrics["realtime_factor"] > 0.0
    assert (metrics["scans_simulated"], metrics["odometry_emulated"], metrics["skipped_frames"]) == (False, False, 0)


def test_every_option_of_track_reaches_the_settings(
    tracked: TrackedRun,
    made_drive: MadeDrive,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[TrackSettings] = []

    def stop(sequence: object, matcher: object, settings: TrackSettings, progress: object) -> None:
        seen.append(settings)
        raise SkyfixError("seen")

    monkeypatch.setattr(learned.matcher, "load_matcher", lambda *_: EmulatedMatcher(made_drive.truth.poses))
    monkeypatch.setattr(sequences.localize, "track", stop)
    options = {
        "--odometry": "wheels",
        "--start": "-22.5 -12 -20",
        "--seed": "9",
        "--half-extent": "31",
        "--measure-every-m": "7.5",
        "--measure-every-frames": "3",
        "--correlation-length-m": "11",
        "--map-error-m": "0.25",
        "--particles": "1234",
        "--watch-map-every": "6",
        "--calibration": str(tracked.out),
    }
    words = [word for option, value in options.items() for word in (option, *value.split())]
    out = ("--out", str(tmp_path / "out"))
    assert skyfix(capsys, monkeypatch, "track", str(made_drive.path), *out, *words, "--heading-unknown").code == 2
    assert seen == [
        TrackSettings(
            odometry="wheels",
            seed=9,
            particles=1234,
            half_extent_m=31.0,
            half_heading_deg=180.0,
            start=(-22.5, -12.0, -20.0),
            measure_every_m=7.5,
            measure_every_frames=3,
            correlation_length_m=11.0,
            map_error_m=0.25,
            map_check_every_m=6.0,
            calibration=OdometryCalibration(
                **json.loads((tracked.out / "metrics.json").read_text())["filter_calibration"]
            ),
        )
    ]
    assert skyfix(capsys, monkeypatch, "track", str(made_drive.path), *out, "--start-anywhere").code == 2
    assert seen[1:] == [TrackSettings(odometry="wheels", start_anywhere=True)]


@pytest.mark.parametrize("change", [None, {"along_noise": "big"}, {"along_noise": 0.0}, {"log_scale": math.nan}])
def test_a_run_without_a_calibration_is_named(
    tracked: TrackedRun,
    change: dict[str, object] | None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = shutil.copytree(tracked.out, tmp_path / "run")
    metrics = json.loads((run / "metrics.json").read_text())
    (run / "metrics.json").write_text(
        json.dumps(metrics | {"filter_calibration": change and metrics["filter_calibration"] | change})
    )
    target = ("--out", str(tmp_path / "out"))
    finished = skyfix(capsys, monkeypatch, "track", str(tracked.made.path), *target, "--calibration", str(run))
    assert finished.code == 2
    assert "filter_calibration" in finished.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("trust", [None, {}, {"doubts": []}, {"doubts": ["lost for 9 of 30 frames"]}])
def test_a_calibration_of_a_doubtful_run_is_taken_with_a_warning(
    tracked: TrackedRun,
    trust: dict[str, list[str]] | None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = shutil.copytree(tracked.out, tmp_path / "run")
    metrics = json.loads((run / "metrics.json").read_text())
    (run / "metrics.json").write_text(json.dumps(metrics | {"trust": trust}))
    monkeypatch.setattr(learned.matcher, "load_matcher", lambda *_: EmulatedMatcher(tracked.made.truth.poses))
    target = ("--out", str(tmp_path / "out"), "--particles", "500", "--quiet")
    finished = skyfix(capsys, monkeypatch, "track", str(tracked.made.path), *target, "--calibration", str(run))
    assert finished.code == 0
    warning = f"warning: --calibration {run}: this run is doubtful: lost for 9 of 30 frames\n"
    assert finished.err == (warning if trust and trust["doubts"] else "")


def test_a_calibration_without_a_blur_is_one_of_none(tracked: TrackedRun, tmp_path: Path) -> None:
    """Runs of earlier versions did not look for it."""
    run = shutil.copytree(tracked.out, tmp_path / "run")
    metrics = json.loads((run / "metrics.json").read_text())
    found = OdometryCalibration(**metrics["filter_calibration"])
    assert read_calibration(run) == found
    del metrics["filter_calibration"]["heading_blur_s"]
    (run / "metrics.json").write_text(json.dumps(metrics))
    assert read_calibration(run) == replace(found, heading_blur_s=0.0)


def test_what_was_found_of_the_odometry_is_told(tracked: TrackedRun) -> None:
    found = OdometryCalibration(-0.11, 0.04, -0.005, 0.014, 0.9, heading_blur_s=0.2, across_noise=0.3)
    metrics = json.loads((tracked.out / "metrics.json").read_text()) | {"odometry_calibration": asdict(found)}
    line = next(line for line in closing_lines(metrics) if "stamps" in line)
    assert "stamps by -0.11 s and its headings by +0.04 s, +0.9 m and +0.29 degrees, sharpened these by 0.2 s" in line
    assert "distances by +1.4 %; took its noise as 1.0, 0.3 and 1.0" in line


def test_view_prints_the_same_table_again(
    tracked: TrackedRun, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    viewed = skyfix(capsys, monkeypatch, "view", str(tracked.out))
    assert viewed.code == 0
    assert viewed.out == tracked.printed.out


def test_a_second_run_into_the_same_directory_needs_overwrite(
    tracked: TrackedRun, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learned.matcher, "load_matcher", lambda *_: EmulatedMatcher(tracked.made.truth.poses))
    again = skyfix(capsys, monkeypatch, "track", str(tracked.made.path), "--out", str(tracked.out))
    assert again.code == 2
    assert "give --overwrite" in again.err


def test_demo_tracks_the_demo_sequence(
    made_drive: MadeDrive, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[str, int]] = []

    def stop(sequence: FolderSequence, matcher: object, settings: TrackSettings, progress: object) -> None:
        seen.append((sequence.name, settings.seed))
        raise SkyfixError("seen")

    monkeypatch.setattr(learned.matcher, "load_matcher", lambda *_: EmulatedMatcher(made_drive.truth.poses))
    monkeypatch.setattr(sequences.demo, "DemoSequence", lambda seed: FolderSequence(made_drive.path, seed))
    monkeypatch.setattr(sequences.localize, "track", stop)
    assert skyfix(capsys, monkeypatch, "demo", "--seed", "4", "--out", str(tmp_path / "out")).code == 2
    assert seen == [("made_drive", 4)]


def test_train_is_handed_its_files_and_shows_its_steps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def train(
        config: Path,
        data: Path,
        out: Path,
        progress: Callable[[int, int, float, float | None], None],
        options: TrainOptions,
    ) -> Path:
        assert (config, data, out) == (Path("net.yaml"), Path("osm"), tmp_path)
        assert options == TrainOptions(("training.seed=1", "training.batch=4"), 2.5, Path("samples"), True)
        for step in range(1, 121):
            progress(step, 120, 1.5, None if step < 100 else 2.25)
        return out / "rotmatch.safetensors"

    monkeypatch.setattr(sequences.train_command, "train_from_config", train)
    files = ["net.yaml", "--data", "osm", "--out", str(tmp_path), "--cache", "samples"]
    how = ["--set", "training.seed=1", "--set", "training.batch=4", "--minutes", "2.5", "--tensorboard"]
    done = skyfix(capsys, monkeypatch, "train", *files, *how)
    assert done.code == 0
    assert done.out == f"checkpoint: {tmp_path / 'rotmatch.safetensors'}\n"
    steps = ["step 50/120: loss 1.500", "step 100/120: loss 1.500, validation 2.250"]
    assert done.err.splitlines() == [*steps, "step 120/120: loss 1.500, validation 2.250"]
    monkeypatch.setenv("RANK", "1")
    assert skyfix(capsys, monkeypatch, "train", *files, *how).out == ""


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_says_how_far_how_fast_and_how_well(terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(np.arange(0.0, 1000.0, 6.0))  # seconds, 6 a look: a line every other frame
    monkeypatch.setattr(sequences.progress.time, "perf_counter", lambda: next(clock))
    written = io.StringIO()
    console = Console(file=written, force_terminal=terminal, width=120)
    row = FrameRow(0, 0, False, "", None, 1.0, 0.0, None, None, None, {})
    with ConsoleProgress(console, "my_drive") as progress:
        progress.start(4)
        for error_m in (1.0, 2.0, 3.0, 4.0):
            progress.frame(row, error_m)
    if terminal:
        assert "my_drive" in written.getvalue()
    else:
        lines = written.getvalue().splitlines()
        assert len(lines) == 2
        assert lines[0].startswith("my_drive: 2/4 frames, ")
        assert lines[0].endswith(" frames/s, error 2.00 m (mean 1.50 m)")


def test_odometry_that_is_not_emulated_is_preferred(made_drive: MadeDrive) -> None:
    wheels = made_drive.path / "odometry" / "wheels.tum"
    wheels.with_name("emulated.tum").write_text(wheels.read_text())
    assert default_odometry(FolderSequence(made_drive.path)) == "wheels"
    wheels.unlink()
    assert default_odometry(FolderSequence(made_drive.path)) == "emulated"


@pytest.mark.parametrize(
    "command", [command.name or command.callback.__name__ for command in app.registered_commands if command.callback]
)
def test_help_explains_every_option_and_gives_an_example(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    shown = skyfix(capsys, monkeypatch, command, "--help")
    assert shown.code == 0
    assert f"skyfix {command}" in shown.out.split("Example")[1]
    for line in shown.out.splitlines():
        option = re.match(r"\W*--([a-z-]+)", line)
        if option:
            assert len(re.sub(r"[^a-z ]", "", line.lower()).split()) >= 4, f"{option[1]}: no explanation"


def test_help_lists_the_commands(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    shown = skyfix(capsys, monkeypatch, "--help")
    assert shown.code == 0
    for command in ("demo", "track", "evaluate", "train", "ablate", "view", "benchmark"):
        assert re.search(rf"\b{command}\b", shown.out)
