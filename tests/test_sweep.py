"""`skyfix sweep`: everything planned is tracked once, tables are the mean over seeds of what the runs hold."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_drive import EmulatedMatcher, MadeDrive, write_made_drive

import sequences.sweep
from fusion.errors import SkyfixError
from sequences.cli import main
from sequences.registry import OpenOptions
from sequences.run_files import read_metrics
from sequences.sweep import sweep
from sequences.sweep_plan import SweepOptions, plan_runs
from sequences.sweep_tables import markdown, write_sweep
from sequences.track_settings import TrackSettings
from sequences.trajectory_io import write_tum

SETTINGS = ("particles=[300, 600]", "measure_every_m=6", "filter.resampler=residual")
GRID = SweepOptions(odometries=("wheels",), seeds=(0, 1), overrides=SETTINGS)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> MadeDrive:
    made = write_made_drive(tmp_path_factory.mktemp("sweep") / "bend")
    write_tum(made.path / "odometry" / "steps.tum", made.odometry)
    write_tum(made.path / "odometry" / "emulated.tum", made.odometry)
    return made


@pytest.fixture
def emulated(made: MadeDrive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sequences.sweep, "load_matcher", lambda _: EmulatedMatcher(made.truth.poses))


@pytest.fixture(scope="module")
def swept(made: MadeDrive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two numbers of particles, two seeds."""
    out = tmp_path_factory.mktemp("swept") / "out"
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(sequences.sweep, "load_matcher", lambda _: EmulatedMatcher(made.truth.poses))
        said: list[str] = []
        assert sweep([made.path], GRID, out, quiet=True, report=said.append) == out / "sweep.md"
    assert len(said) == 4
    assert said[0] == "bend, wheels, rotmatch, particles 300, seed 0 (1 of 4)"
    return out


def test_a_plan_is_every_combination_with_the_seeds_outermost(made: MadeDrive, tmp_path: Path) -> None:
    runs = plan_runs([made.path], replace(GRID, odometries=()), tmp_path)
    assert [(run.settings.seed, run.settings.odometry, run.settings.particles) for run in runs] == [
        (seed, odometry, particles) for seed in (0, 1) for odometry in ("steps", "wheels") for particles in (300, 600)
    ]
    assert {run.settings.filter.resampler for run in runs} == {"residual"}
    assert {run.settings.measure_every_m for run in runs} == {6.0}
    assert {tuple(run.changes) for run in runs} == {("particles",)}
    assert runs[0].folder == tmp_path / "runs" / "bend-steps-rotmatch-particles-300" / "seed-0"
    own = str(tmp_path / "mine" / "rotmatch.safetensors")
    only = plan_runs([made.path], SweepOptions(("emulated", "gps"), ("rotmatch", own)), tmp_path)
    assert [run.settings for run in only] == 2 * [TrackSettings("emulated")]
    assert [run.variant for run in only] == ["rotmatch", "mine/rotmatch"]
    assert only[1].folder == tmp_path / "runs" / "bend-emulated-mine_rotmatch" / "seed-0"


def test_tables_are_of_what_the_runs_hold(swept: Path) -> None:
    content = json.loads((swept / "sweep.json").read_text())
    assert (content["runs_done"], content["runs_planned"], content["failed"]) == (4, 4, {})
    for table in content["tables"]:
        assert (table["sequence"], table["scans_simulated"], table["odometry_emulated"]) == ("bend", False, False)
        for particles in (300, 600):
            facts = table["variants"][f"rotmatch, particles {particles}"]
            assert (facts["matcher"], facts["changes"], facts["seeds"]) == (
                "rotmatch",
                {"particles": particles},
                [0, 1],
            )
            folder = swept / "runs" / f"bend-{table['odometry']}-rotmatch-particles-{particles}"
            held = [read_metrics(folder / f"seed-{seed}") for seed in (0, 1)]
            for method in ("prior", "odometry", "single_shot", "filter", "smoother"):
                means = [each[method]["position_error_m"]["mean"] for each in held]
                found = facts["methods"][method]["position_error_m.mean"]
                assert found["mean"] == pytest.approx(np.mean(means), abs=1e-6)
                assert found["std"] == pytest.approx(np.std(means, ddof=1), abs=1e-6)
                assert method == "single_shot" or means[0] != means[1], "the seed reaches the run"
    text = (swept / "sweep.md").read_text()
    assert text == markdown(content)
    assert "## bend: 58 m, 30 frames, real scans, odometry wheels\n" in text
    lines = [line.split(" | ")[:2] for line in text.splitlines() if line.startswith("| ")]
    expected = [
        ["| method", "matcher, settings"],
        ["| prior", "-"],
        ["| odometry", "-"],
        ["| odometry, true start", "-"],
    ]
    expected += [
        [f"| {method}", f"rotmatch, particles {particles}"]
        for method in ("single shot", "filter", "filter, after first quarter", "smoother")
        for particles in (300, 600)
    ]
    assert lines == expected
    assert (swept / "sweep.png").read_bytes().startswith(b"\x89PNG")


def test_what_a_run_lacks_is_left_out_and_what_it_doubts_is_told(made: MadeDrive, swept: Path, tmp_path: Path) -> None:
    out = shutil.copytree(swept, tmp_path / "out")
    runs = plan_runs([made.path], GRID, out)
    spoiled = next(run for run in runs if run.settings.seed == 1 and run.settings.particles == 300)
    metrics = read_metrics(spoiled.folder)
    del metrics["single_shot"]
    metrics["trust"]["doubts"] = ["lost for 9 of 30 frames"]
    (spoiled.folder / "metrics.json").write_text(json.dumps(metrics))
    write_sweep(out, runs, {})
    text = (out / "sweep.md").read_text()
    assert "| single shot | rotmatch, particles 600 |" in text
    assert "| single shot | rotmatch, particles 300 |" not in text
    assert "| filter | rotmatch, particles 300 |" in text
    assert "- rotmatch, particles 300, seed 1: doubtful: lost for 9 of 30 frames\n" in text


def test_what_is_there_is_not_tracked_again(
    made: MadeDrive, swept: Path, emulated: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sequences.sweep, "track", None)
    before = (swept / "sweep.md").read_text()
    (swept / "sweep.md").unlink()
    said: list[str] = []
    sweep([made.path], GRID, swept, report=said.append)
    assert said == ["4 of 4 runs are there already"]
    assert (swept / "sweep.md").read_text() == before


def test_other_runs_in_the_folder_are_kept(
    made: MadeDrive, swept: Path, emulated: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sequences.sweep, "track", None)
    others = replace(GRID, overrides=SETTINGS[:2])
    with pytest.raises(SkyfixError, match=r"was tracked with filter\.resampler residual and not systematic") as caught:
        sweep([made.path], others, swept)
    assert "\n" not in str(caught.value)


def test_runs_of_weights_that_have_changed_since_are_refused(
    made: MadeDrive, swept: Path, emulated: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sequences.sweep, "track", None)
    weights = tmp_path / "net.safetensors"
    weights.write_bytes(b"")
    mine = replace(GRID, matchers=(str(weights),))
    out = tmp_path / "out"
    for before, now in zip(plan_runs([made.path], GRID, swept), plan_runs([made.path], mine, out), strict=True):
        shutil.copytree(before.folder, now.folder)
    newest = max(path.stat().st_mtime for path in out.rglob("metrics.json"))
    os.utime(weights, (newest + 10.0, newest + 10.0))
    with pytest.raises(SkyfixError, match=r"is older than .*net\.safetensors; choose another --out"):
        sweep([made.path], mine, out)
    os.utime(weights, (0.0, 0.0))
    said: list[str] = []
    sweep([made.path], mine, out, report=said.append)
    assert said == ["4 of 4 runs are there already"]


def test_a_run_that_fails_is_listed_and_the_others_are_done(
    made: MadeDrive,
    emulated: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    real: Callable[..., object] = sequences.sweep.track

    def track(sequence: object, matcher: object, settings: TrackSettings, progress: object) -> object:
        if settings.odometry == "steps":
            raise SkyfixError("odometry: expected steps, got none")
        return real(sequence, matcher, settings, progress)

    monkeypatch.setattr(sequences.sweep, "track", track)
    out = tmp_path / "out"
    monkeypatch.setattr(sys, "argv", ["skyfix", "sweep", str(made.path), "--set", "particles=300", "--out", str(out)])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 2
    printed = capsys.readouterr()
    assert "bend, steps, rotmatch, seed 0: failed: odometry: expected steps, got none" in printed.err
    assert "skyfix: error: 1 of 2 runs failed, see" in printed.err.splitlines()[-1]
    content = json.loads((out / "sweep.json").read_text())
    assert (content["runs_done"], content["runs_planned"]) == (1, 2)
    assert content["failed"] == {"bend, steps, rotmatch, seed 0": "odometry: expected steps, got none"}
    assert [table["odometry"] for table in content["tables"]] == ["wheels"]
    assert content["tables"][0]["variants"]["rotmatch"]["seeds"] == [0]
    assert "- bend, steps, rotmatch, seed 0: odometry: expected steps, got none\n" in (out / "sweep.md").read_text()


def test_a_drive_is_opened_with_the_seed_of_its_run(
    made: MadeDrive, emulated: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where scans are simulated, they are of that seed."""
    seeds: list[int] = []

    def opening(path: Path, options: OpenOptions) -> None:
        seeds.append(options.seed)
        raise SkyfixError("drive: expected one, got none")

    monkeypatch.setattr(sequences.sweep, "open_sequence", opening)
    with pytest.raises(SkyfixError, match=r"2 of 2 runs failed, see .*: drive: expected one, got none"):
        sweep([made.path], SweepOptions(("wheels",), seeds=(3, 5)), tmp_path / "out")
    assert seeds == [3, 5]


def test_several_at_once_give_the_same_numbers(made: MadeDrive, tmp_path: Path) -> None:
    options = SweepOptions(("wheels",), ("geometric",), (0, 1), ("particles=300", "measure_every_m=20"))
    said: list[str] = []
    sweep([made.path], options, tmp_path / "one", quiet=True)
    sweep([made.path], options, tmp_path / "two", jobs=2, report=said.append)
    assert {line.partition(": done")[0] for line in said} == {
        f"bend, wheels, geometric, seed {seed}" for seed in (0, 1)
    }
    assert [line.rpartition(" (")[2] for line in said] == ["1 of 2)", "2 of 2)"]
    one, two = (json.loads((tmp_path / name / "sweep.json").read_text()) for name in ("one", "two"))
    assert one == two


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seeds": ()}, "--seeds: expected distinct numbers"),
        ({"seeds": (1, 1)}, "--seeds: expected distinct numbers"),
        ({"matchers": ()}, "--matcher: expected matchers of distinct names, got none"),
        ({"matchers": ("x/a/net.safetensors", "y/a/net.safetensors")}, "distinct names, got a/net, a/net"),
        ({"odometries": ("gps",)}, "bend: expected one of gps, found emulated, steps, wheels"),
        ({"overrides": ("particles=[]",)}, r"--set particles=\[\]: expected a value or a list of them"),
        ({"overrides": ("particles=[300, none]",)}, "--set particles=none: Input should be a valid integer"),
        ({"overrides": ("seed=[1, 2]",)}, "--set seed=1: expected one of particles=VALUE"),
        ({"overrides": ("particles=[300, 300]",)}, "sweep: expected runs that differ"),
    ],
)
def test_a_bad_plan_is_one_line_and_nothing_is_tracked(
    made: MadeDrive, tmp_path: Path, options: dict[str, tuple[str, ...]], message: str
) -> None:
    with pytest.raises(SkyfixError, match=message) as caught:
        plan_runs([made.path], SweepOptions(**options), tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_drives_that_cannot_be_compared_are_refused(made_drive: MadeDrive, made: MadeDrive, tmp_path: Path) -> None:
    with pytest.raises(SkyfixError, match="drives of distinct names, got bend, bend"):
        plan_runs([made.path, made.path], SweepOptions(), tmp_path)
    with pytest.raises(SkyfixError, match="drives of distinct names, got none"):
        plan_runs([], SweepOptions(), tmp_path)
    (made_drive.path / "ground_truth.tum").unlink()
    with pytest.raises(SkyfixError, match="made_drive: expected ground truth to compare with, found none"):
        plan_runs([made_drive.path], SweepOptions(), tmp_path)
    with pytest.raises(SkyfixError, match="--jobs: expected 1 or more, got 0"):
        sweep([made.path], SweepOptions(), tmp_path, jobs=0)
