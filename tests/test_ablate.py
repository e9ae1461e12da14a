"""`skyfix ablate`: variants and seeds trained, scored and tabled; finished runs kept, interrupted ones taken up."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from safetensors.numpy import load_file

from fusion.errors import SkyfixError
from sequences.ablate import SIMULATED, AblateOptions, ablate
from sequences.ablation_config import read_ablation
from sequences.ablation_tables import mean_and_std
from sequences.cli import main
from sequences.shot_scores import box_nll

BASE = """
extracts: {"pyrosm:test.osm.pbf": 1.0}
validation_extract: pyrosm:test.osm.pbf
validation_samples: 1
calibration_samples: 2
matching_half_extent_m: 40.0
simulation: {samples: 2, samples_per_area: 2, azimuths: [300, 300]}
training:
  steps: 2
  batch: 2
  workers: 0
  validate_every: 1
  network: {channels: 4, widths: [4, 4, 8, 8]}
"""
ABLATION = """
base: base.yaml
evaluation_samples: 3
variants:
  full: {}
  "wider, twice": {training.network.channels: 8, training.learning_rate: 1.0e-05}
"""


class StoppedError(Exception):
    """The run was interrupted."""


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("samples")


@pytest.fixture
def config(tmp_path: Path) -> Path:
    (tmp_path / "base.yaml").write_text(BASE)
    path = tmp_path / "parts.yaml"
    path.write_text(ABLATION)
    return path


def test_every_variant_and_seed_is_trained_scored_and_kept(config: Path, tmp_path: Path, cache: Path) -> None:
    out, said = tmp_path / "out", list[str]()
    options = AblateOptions((0, 3), cache_dir=cache, half_headings_deg=(10.0, 180.0))
    page = ablate(config, tmp_path, out, options=options, report=said.append)
    order = ["full, seed 0", "wider, twice, seed 0", "full, seed 3", "wider, twice, seed 3"]
    assert said == [f"{label} ({number} of 4)" for number, label in enumerate(order, start=1)]
    content = json.loads((out / "ablation.json").read_text())
    assert [table["start"]["half_heading_deg"] for table in content["tables"]] == [10.0, 180.0]
    assert content["variants"]["wider, twice"]["parameters"] > content["variants"]["full"]["parameters"]
    assert content["variants"]["full"]["cpu_minutes"]["mean"] > 0
    assert content["variants"]["wider, twice"]["steps"] == 2
    for table in content["tables"]:
        assert table["sequence"] == SIMULATED
        assert table["scans_simulated"]
        assert table["prior"]["frames"] == 3
        half_heading = np.radians(table["start"]["half_heading_deg"])
        assert table["prior"]["likelihood"]["nll"] == pytest.approx(box_nll(20.0, half_heading), abs=1e-6)
        lines = [line for line in page.read_text().splitlines() if line.startswith("|")]
        for name, scores in table["variants"].items():
            folder = out / "runs" / ("full" if name == "full" else "wider-twice")
            values = []
            for seed in (0, 3):
                evaluations = json.loads((folder / f"seed-{seed}" / "evaluations.json").read_text())
                same = next(each for each in evaluations if each["start"] == table["start"])
                values.append(same["methods"]["network"]["position_error_m"]["mean"])
            assert scores["position_error_m.mean"] == pytest.approx(mean_and_std(values), abs=1e-6)
            assert any(line.startswith(f"| {name} | {np.mean(values):.2f} ± ") for line in lines)
    headers = [number for number, line in enumerate(lines) if "mean m" in line]
    assert len(headers) == 2
    assert all(lines[number + 2].startswith("| prior | ") for number in headers)

    weights = {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")}
    assert len(weights) == 4
    again = list[str]()
    ablate(config, tmp_path, out, options=options, report=again.append, progress=_refuse)
    assert again == [f"{line}: trained already" for line in said]
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")} == weights
    assert json.loads((out / "ablation.json").read_text()) == content
    with pytest.raises(SkyfixError, match=r"was trained with training\.steps 2 and not 3; choose another --out"):
        ablate(config, tmp_path, out, options=AblateOptions(cache_dir=cache, overrides=("training.steps=3",)))


def test_an_interrupted_run_goes_on_to_the_same_weights(config: Path, tmp_path: Path, cache: Path) -> None:
    config.write_text("base: base.yaml\nevaluation_samples: 2\nvariants: {full: {}}\n")
    options = AblateOptions(cache_dir=cache)

    def stop(step: int, steps: int, loss: float, validation: float | None) -> None:
        if step == 1:
            raise StoppedError

    with pytest.raises(StoppedError):
        ablate(config, tmp_path, tmp_path / "stopped", options=options, progress=stop)
    folder = tmp_path / "stopped" / "runs" / "full" / "seed-0"
    assert not (folder / "finished.json").exists()
    spent = json.loads((folder / "cpu.json").read_text())["seconds"]
    steps = list[int]()
    ablate(config, tmp_path, tmp_path / "stopped", options=options, progress=lambda step, *_: steps.append(step))
    assert steps == [2]
    assert 60 * json.loads((folder / "finished.json").read_text())["cpu_minutes"] > spent
    ablate(config, tmp_path, tmp_path / "straight", options=options)
    resumed, straight = (
        load_file(tmp_path / name / "runs" / "full" / "seed-0" / "rotmatch.safetensors")
        for name in ("stopped", "straight")
    )
    assert resumed.keys() == straight.keys()
    for name, value in straight.items():
        np.testing.assert_array_equal(resumed[name], value)


def test_a_grid_is_every_combination_and_gets_a_table_of_its_own(config: Path, tmp_path: Path, cache: Path) -> None:
    config.write_text(
        "base: base.yaml\nevaluation_samples: 2\n"
        "grid: {training.learning_rate: [0.001, 0.002], training.weight_decay: [0.0, 0.1]}\n"
    )
    ablation = read_ablation(config)
    assert [variant.point for variant in ablation.variants] == [(0.001, 0.0), (0.001, 0.1), (0.002, 0.0), (0.002, 0.1)]
    rates = [(v.config.training.learning_rate, v.config.training.weight_decay) for v in ablation.variants]
    assert rates == [variant.point for variant in ablation.variants]
    assert len({variant.folder for variant in ablation.variants}) == 4
    options = AblateOptions(cache_dir=cache, overrides=("training.steps=1",))
    page = ablate(config, tmp_path, tmp_path / "out", options=options).read_text()
    (score,) = json.loads((tmp_path / "out" / "ablation.json").read_text())["tables"]
    corner = page.splitlines().index("| learning_rate \\ weight_decay | 0.0 | 0.1 |")
    means = [scores["position_error_m.mean"]["mean"] for scores in score["variants"].values()]
    assert page.splitlines()[corner + 2] == f"| 0.001 | {means[0]:.2f} | {means[1]:.2f} |"
    assert page.splitlines()[corner + 3] == f"| 0.002 | {means[2]:.2f} | {means[3]:.2f} |"


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
    changes = {"training.learning_rate": 1e-5, "training.network": {"architecture": "rotmatch", "channels": 6}}
    config.write_text(yaml.safe_dump({"base": "base.yaml", "variants": {"a": {**changes, "training.ema_decay": None}}}))
    (variant,) = read_ablation(config).variants
    assert variant.config.training.learning_rate == 1e-5
    assert variant.config.training.network.settings.channels == 6
    assert variant.config.training.network.settings.widths == (16, 32, 48, 64)


def _refuse(*_: object) -> None:
    raise AssertionError("a finished run was trained again")
