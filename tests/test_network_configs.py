"""The configurations that come with the baselines: readable, of the network that they are named after, comparable."""

from pathlib import Path

import pytest
import yaml

import learned
from learned.architectures import ARCHITECTURES
from sequences.train_config import read_config

FOLDER = Path(learned.__file__).parent
CONFIGS = sorted((FOLDER / "configs").glob("*.yaml"))


def test_every_baseline_has_one() -> None:
    assert {"aglnet", "hybrid", "orienternet"} <= {path.stem for path in CONFIGS}


@pytest.mark.parametrize("name", ["aglnet", "hybrid", "orienternet"])
def test_a_configuration_is_of_its_network_and_on_the_samples_of_rotmatch(name: str) -> None:
    path = FOLDER / "configs" / f"{name}.yaml"
    config, shipped = read_config(path), read_config(FOLDER / "weights" / "rotmatch.yaml")
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
