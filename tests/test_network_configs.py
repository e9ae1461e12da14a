"""The configurations that come with the baselines: readable, of the network that they are named after, comparable."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import learned
from learned.architectures import ARCHITECTURES
from sequences.ablation_config import read_ablation
from sequences.train_config import read_config
from sequences.world_style import WorldStyle

FOLDER = Path(learned.__file__).parent
CONFIGS = sorted((FOLDER / "configs").glob("*.yaml"))


def test_every_baseline_has_one() -> None:
    assert {"aglnet", "hybrid", "orienternet"} <= {path.stem for path in CONFIGS}


@pytest.mark.parametrize("name", ["aglnet", "hybrid", "orienternet"])
def test_a_configuration_is_of_its_network_and_on_the_samples_of_rotmatch(name: str) -> None:
    path = FOLDER / "configs" / f"{name}.yaml"
    config, shipped = read_config(path), read_config(FOLDER / "weights" / "rotmatch_near.yaml")
    network = config.training.network
    assert network.name == name
    assert network.settings == ARCHITECTURES[name].settings_type()  # what is recommended is the default
    assert config.simulation == shipped.simulation
    assert config.extracts == shipped.extracts
    assert config.training.augmentation == shipped.training.augmentation
    assert sum(parameter.numel() for parameter in network.build().parameters()) < 1_000_000


@pytest.mark.parametrize("name", ["aglnet", "hybrid", "orienternet"])
def test_a_configuration_names_every_setting_once(name: str) -> None:
    """Sizes and switches are spelled out, so that an ablation changes a line and adds none."""
    stated = yaml.safe_load((FOLDER / "configs" / f"{name}.yaml").read_text())["training"]["network"]
    known = set(ARCHITECTURES[name].settings_type.__dataclass_fields__)
    assert set(stated) - {"architecture"} >= known - {"bev", "quadrature"}


@pytest.mark.parametrize(
    ("name", "architecture"), [("translocnet", "translocnet"), ("translocnet_compact", "translocnet-compact")]
)
def test_the_configurations_of_translocnet_are_of_the_paper_and_on_the_samples_of_rotmatch(
    name: str, architecture: str
) -> None:
    config, shipped = (
        read_config(FOLDER / "configs" / f"{name}.yaml"),
        read_config(FOLDER / "weights" / "rotmatch_near.yaml"),
    )
    network, augmentation = config.training.network, config.training.augmentation
    assert network.name == architecture
    assert network.settings == ARCHITECTURES[architecture].settings_type()
    assert (network.settings.loss.regression, network.settings.loss.contrastive) == (2.0, 0.1)
    assert (augmentation.rotate, augmentation.rotate_deg, augmentation.half_heading_deg) == (0.7, 60.0, 10.0)
    assert config.simulation == shipped.simulation
    assert config.extracts == shipped.extracts


@pytest.mark.parametrize(
    "name",
    ["ablation_hybrid", "ablation_hybrid_own", "ablation_translocnet", "sensitivity_hybrid", "sensitivity_translocnet"],
)
def test_every_line_of_an_ablation_is_a_network_of_its_own(name: str) -> None:
    ablation = read_ablation(FOLDER / "configs" / f"{name}.yaml")
    base = read_config(ablation.base)
    settings = [variant.config.training.network for variant in ablation.variants]
    assert len({repr(each) for each in settings}) == len(settings)
    assert sum(each == base.training.network for each in settings) == 1  # "full", or the grid's point of the paper
    for variant in ablation.variants:
        rest = variant.config.model_copy(update={"training": base.training})
        assert rest == base
        assert len(variant.changes) <= 5


def test_the_ablation_of_the_simulation_takes_away_one_measure_a_line_and_all_in_the_last() -> None:
    ablation = read_ablation(FOLDER / "configs" / "ablation_simulation.yaml")
    base = read_config(ablation.base)
    first, *single, last = (variant.changes for variant in ablation.variants)
    assert first == {}
    assert ablation.variants[0].config == base
    together: dict[str, Any] = {}
    for key, value in ((key, value) for changes in single for key, value in changes.items()):
        together[key] = {**together.get(key, {}), **value} if isinstance(value, dict) else value
    assert last == together
    known = asdict(WorldStyle.random(np.random.default_rng(0)))
    for key in last["simulation.world"]:
        assert known[key] != 0.0, key


def test_the_sensitivity_grid_is_the_papers() -> None:
    ablation = read_ablation(FOLDER / "configs" / "sensitivity_translocnet.yaml")
    assert [list(values) for values in ablation.grid.values()] == [[0.5, 1.0, 2.0, 4.0], [0.05, 0.1, 0.2, 0.5]]
    weights = {
        (v.config.training.network.settings.loss.regression, v.config.training.network.settings.loss.contrastive)
        for v in ablation.variants
    }
    assert len(weights) == 16
