"""`skyfix ablate`: variants and seeds trained, scored and tabled; finished runs kept, interrupted ones taken up."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from safetensors.numpy import load_file

from fusion.errors import SkyfixError
from sequences.ablate import SIMULATED, AblateOptions, ablate
from sequences.ablation_config import read_ablation
from sequences.ablation_run import FinishedRun, Run
from sequences.ablation_tables import markdown, summary
from sequences.cli import main
from sequences.shot_protocol import ShotProtocol
from sequences.shot_scores import ShotScore, box_nll, summarise_shots
from sequences.train_command import TrainOptions, train_from_config

BASE = """
extracts: {"pyrosm:test.osm.pbf": 1.0}
validation_extract: pyrosm:test.osm.pbf
validation_samples: 1
calibration_samples: 2
matching_half_extent_m: 24.0
simulation: {samples: 2, samples_per_area: 2, azimuths: [300, 300], bev_half_extent_m: 24.0}
training:
  steps: 2
  batch: 2
  workers: 0
  validate_every: 1
  network:
    architecture: hybrid
    channels: 4
    widths: [8, 8, 8, 8]
    bev: {half_extent_m: 24.0}
"""
ABLATION = """
base: base.yaml
evaluation_samples: 2
variants:
  full: {}
  "other, twice": {training.network.scan_worth: false, training.learning_rate: 1.0e-05}
"""


class StoppedError(Exception):
    """The run was interrupted."""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    (tmp_path / "base.yaml").write_text(BASE)
    path = tmp_path / "parts.yaml"
    path.write_text(ABLATION)
    return path


def test_every_variant_and_seed_is_trained_scored_and_kept(config: Path, tmp_path: Path) -> None:
    """Stopped in the second run after its first step; what is there then is neither lost nor made again."""
    out, cache = tmp_path / "out", tmp_path / "samples"
    options = AblateOptions((0, 3), cache_dir=cache, half_headings_deg=(10.0, 180.0))
    labels = ["full, seed 0", "other, twice, seed 0", "full, seed 3", "other, twice, seed 3"]
    numbered = [f"{label} ({number} of 4)" for number, label in enumerate(labels, start=1)]
    first, steps = list[str](), list[int]()

    def stop(step: int, *_: object) -> None:
        steps.append(step)
        if steps == [1, 2, 1]:
            raise StoppedError

    with pytest.raises(StoppedError):
        ablate(config, tmp_path, out, options=options, progress=stop, report=first.append)
    assert first == numbered[:2]
    stopped = out / "runs" / "other-twice" / "seed-0"
    assert not (stopped / "finished.json").exists()
    spent = json.loads((stopped / "cpu.json").read_text())["seconds"]
    partial = json.loads((out / "ablation.json").read_text())
    assert (partial["runs_done"], partial["runs_planned"], list(partial["variants"])) == (1, 4, ["full"])

    said = list[str]()
    page = ablate(config, tmp_path, out, options=options, progress=stop, report=said.append)
    assert said == [f"{numbered[0]}: trained already", *numbered[1:]]
    assert steps == [1, 2, 1, 2, 1, 2, 1, 2]
    assert 60 * json.loads((stopped / "finished.json").read_text())["cpu_minutes"] > spent > 0
    overrides = ("training.network.scan_worth=false", "training.learning_rate=0.00001")
    straight = load_file(
        train_from_config(
            tmp_path / "base.yaml", tmp_path, tmp_path / "on", options=TrainOptions(overrides, None, cache)
        )
    )
    resumed = load_file(stopped / "hybrid.safetensors")
    assert resumed.keys() == straight.keys()
    for name, value in straight.items():
        np.testing.assert_array_equal(resumed[name], value)

    content = json.loads((out / "ablation.json").read_text())
    _check_tables(content, out, page)
    weights = {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")}
    assert len(weights) == 4
    ablate(config, tmp_path, out, options=options, progress=_refuse)
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")} == weights
    assert json.loads((out / "ablation.json").read_text()) == content
    for changed, message in (
        (
            replace(options, overrides=("training.steps=3",)),
            r"trained with training\.steps 2 and not 3; choose another",
        ),
        (replace(options, overrides=("simulation.seed=1",)), r"trained with simulation\.seed 0 and not 1"),
    ):
        with pytest.raises(SkyfixError, match=message):
            ablate(config, tmp_path, out, options=changed)
    ablate(config, tmp_path, out, options=replace(options, minutes=5.0), progress=_refuse)  # keeps its steps


def _check_tables(content: dict[str, Any], out: Path, page: Path) -> None:
    full, other = content["variants"]["full"], content["variants"]["other, twice"]
    assert other["parameters"] < full["parameters"]
    assert full["cpu_minutes"]["mean"] > 0
    assert full["cpu_minutes"]["std"] is not None
    assert (other["steps"], other["seeds"]) == (2, [0, 3])
    lines = [line for line in page.read_text().splitlines() if line.startswith("|")]
    headers = [number for number, line in enumerate(lines) if "mean m" in line]
    assert len(headers) == len(content["tables"]) == 2
    assert all(lines[number + 2].startswith("| prior | ") for number in headers)
    for table, half_heading_deg in zip(content["tables"], (10.0, 180.0), strict=True):
        assert table["start"]["half_heading_deg"] == half_heading_deg
        assert table["sequence"] == SIMULATED
        assert table["scans_simulated"]
        assert table["prior"]["frames"] == 2
        assert table["prior"]["likelihood"]["nll"] == pytest.approx(
            box_nll(20.0, np.radians(half_heading_deg)), abs=1e-6
        )
        for name, folder in (("full", "full"), ("other, twice", "other-twice")):
            values = []
            for seed in (0, 3):
                found = json.loads((out / "runs" / folder / f"seed-{seed}" / "evaluations.json").read_text())
                same = next(each for each in found if each["start"] == table["start"])
                values.append(same["methods"]["network"]["position_error_m"]["mean"])
            scores = table["variants"][name]["position_error_m.mean"]
            spread = abs(values[0] - values[1]) / np.sqrt(2)
            assert scores == pytest.approx({"mean": np.mean(values), "std": spread}, abs=1e-6)
            assert any(line.startswith(f"| {name} | {np.mean(values):.2f} ± {spread:.2f} |") for line in lines)


def test_a_grid_is_every_combination_and_gets_a_table_of_its_own(config: Path) -> None:
    config.write_text(
        "base: base.yaml\ngrid: {training.learning_rate: [0.001, 0.002], training.weight_decay: [0.0, 0.1]}"
    )
    ablation = read_ablation(config)
    points = [(0.001, 0.0), (0.001, 0.1), (0.002, 0.0), (0.002, 0.1)]
    assert [variant.point for variant in ablation.variants] == points
    rates = [(v.config.training.learning_rate, v.config.training.weight_decay) for v in ablation.variants]
    assert rates == points
    assert len({variant.folder for variant in ablation.variants}) == 4
    truth = np.zeros((1, 3))
    finished = []
    for number, variant in enumerate(ablation.variants[:3]):  # the last is not done yet
        run = Run(variant, 0, ablation.base, (), config.parent / variant.folder, config.parent)
        answer = summarise_shots(truth, [ShotScore(np.array([number + 1.0, 0.0, 0.0]), 1.0, 1.0)], None)
        told = {"sequence": "drive", "scans_simulated": False, "start": ShotProtocol().stated()["start"]}
        methods = {"prior": answer, "network": answer}
        finished.append(FinishedRun(run, 2, 1000, 0.5, ({**told, "methods": methods},)))
    lines = markdown(summary(ablation, finished, 4)).splitlines()
    corner = lines.index("| learning_rate \\ weight_decay | 0.0 | 0.1 |")
    assert lines[corner + 2 : corner + 4] == ["| 0.001 | 1.00 | 2.00 |", "| 0.002 | 3.00 | - |"]
    assert "## drive: 1 real scans, start within ±20 m, ±10°" in lines


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("base: none.yaml\nvariants: {full: {}}", "config: expected a YAML file at .*none.yaml, got no such file"),
        ("base: base.yaml\nvariants: {a: {training.network.chanels: 4}}", "variant 'a': config base.yaml: .*chanels"),
        ("base: base.yaml\nvariants: {a: {trainin.steps: 4}}", "variant 'a': config base.yaml: trainin: Extra"),
        ("base: base.yaml\nvariants: {a: {training.steps: many}}", "variant 'a': .*training.steps: .*'many'"),
        ("base: base.yaml\nvariants: {a: {training.seed: 1}}", "variant 'a': training.seed: expected to be left to"),
        ("base: base.yaml\nvariants: {a: {}, A: {}}", "expected names that make distinct folders, got 'A' and 'a'"),
        ("base: base.yaml\nvariants: {'+': {}}", "expected names that make distinct folders, got '\\+'"),
        ("base: base.yaml", "expected variants or a grid, got neither"),
        ("base: base.yaml\nvariant: {a: {}}", "ablation parts.yaml: variant: Extra inputs"),
        ("variants: {a: {}}", "ablation parts.yaml: base: Field required"),
        ("base: [", "ablation parts.yaml: expected YAML"),
        ("just text", "ablation parts.yaml: "),
    ],
)
def test_a_bad_ablation_is_one_line(
    config: Path, text: str, message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    config.write_text(text)
    monkeypatch.setattr(sys, "argv", ["skyfix", "ablate", str(config), "--out", str(config.parent / "out")])
    with pytest.raises(SystemExit) as caught:
        main()
    printed = capsys.readouterr().err
    assert caught.value.code == 2
    assert printed.startswith("skyfix: error: ")
    assert printed.count("\n") == 1
    with pytest.raises(SkyfixError, match=message):
        read_ablation(config)
    assert not (config.parent / "out").exists()


def test_bad_options_are_named(config: Path, tmp_path: Path) -> None:
    for seeds in ((), (1, 1), (-1,)):
        with pytest.raises(SkyfixError, match=r"--seeds: expected distinct numbers of zero or more"):
            AblateOptions(seeds)
    config.write_text("base: base.yaml\nvariants: {full: {}, long: {training.steps: 9}}\n")
    with pytest.raises(SkyfixError, match=r"--minutes: expected variants that leave training\.steps alone"):
        ablate(config, tmp_path, tmp_path / "out", options=AblateOptions(minutes=1.0))
    with pytest.raises(SkyfixError, match="half heading: expected above 0 and at most 180 degrees, got 0"):
        ablate(config, tmp_path, tmp_path / "out", options=AblateOptions(half_headings_deg=(0.0,)))


def test_values_survive_the_way_through_overrides(config: Path) -> None:
    network = {"architecture": "rotmatch", "channels": 6, "bev": {"half_extent_m": 24.0}}
    changes = {"training.learning_rate": 1e-5, "training.network": network}
    config.write_text(yaml.safe_dump({"base": "base.yaml", "variants": {"a": {**changes, "training.ema_decay": None}}}))
    (variant,) = read_ablation(config).variants
    assert variant.config.training.learning_rate == 1e-5
    assert variant.config.training.network.settings.channels == 6
    assert variant.config.training.network.settings.widths == (16, 32, 48, 64)


def _refuse(*_: object) -> None:
    raise AssertionError("a finished run was trained again")
