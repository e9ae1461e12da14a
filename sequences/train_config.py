"""The configuration of `skyfix train`: YAML plus dotted overrides, checked key by key, and written out resolved."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from fusion.errors import SkyfixError
from learned.samples import SAMPLE_METRES_PER_PIXEL
from learned.training import TrainingSettings
from sequences.dotted_keys import dotted, split_override
from sequences.training_data import SimulationSettings

RESOLVED_FILE = "config.yaml"
_FAR_REACH_M = 72.0
_FREE_KEYS = ("training.workers", "calibration_samples")


class TrainConfig(BaseModel):
    """A training run; unknown keys are refused.

    Training sees scans to the reach of `training.network.bev`; afterwards the network is calibrated, and used, with
    scans to `matching_half_extent_m`, where its architecture allows another reach. Left out, that is 72 m, or the
    network's own reach where it has but one. `initial` names the checkpoint that it started from, and `averaged` those
    whose weights are averaged with the trained ones, see `with_checkpoints`; `averaged_shares` are their shares, and
    the rest is the trained ones'. What was learned in training narrows, and an average is at home in all domains
    (Wortsman et al., "Model soups", ICML 2022).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    initial: str | None = None
    averaged: tuple[str, ...] = ()
    averaged_shares: tuple[Annotated[float, Field(gt=0.0, lt=1.0)], ...] = ()
    extracts: dict[str, Annotated[float, Field(gt=0.0, allow_inf_nan=False)]]
    matching_half_extent_m: float | None = None
    validation_extract: str
    validation_samples: Annotated[int, Field(ge=1)] = 96
    calibration_samples: Annotated[int, Field(ge=2)] = 64
    simulation: SimulationSettings = SimulationSettings()
    training: TrainingSettings = TrainingSettings()

    @property
    def matching_reach_m(self) -> float:
        """The reach that the network is calibrated and used with, metres."""
        own: float = self.training.network.settings.bev.half_extent_m
        if self.matching_half_extent_m is not None:
            return self.matching_half_extent_m
        return own if self.training.network.architecture.reaching is None else _FAR_REACH_M

    def check(self) -> None:
        """Raise SkyfixError where the simulated views are not what the network is to be given."""
        network, bev = self.training.network, self.training.network.settings.bev
        if bev.half_extent_m != self.simulation.bev_half_extent_m:
            raise SkyfixError(
                f"simulation.bev_half_extent_m: expected {bev.half_extent_m:g} as training.network.bev, "
                f"got {self.simulation.bev_half_extent_m:g}"
            )
        if bev.ground != self.simulation.ground:
            raise SkyfixError(
                f"simulation.ground: expected {bev.ground} as training.network.bev, got {self.simulation.ground}"
            )
        if bev.metres_per_pixel != SAMPLE_METRES_PER_PIXEL:
            raise SkyfixError(
                f"training.network.bev.metres_per_pixel: expected {SAMPLE_METRES_PER_PIXEL}, got {bev.metres_per_pixel}"
            )
        if network.architecture.reaching is None and self.matching_reach_m != bev.half_extent_m:
            raise SkyfixError(
                f"matching_half_extent_m: expected {bev.half_extent_m:g}, the one reach of {network.name}, "
                f"got {self.matching_reach_m:g}"
            )
        if sum(self.averaged_shares) >= 1.0:
            raise SkyfixError(f"averaged_shares: expected a sum below 1, got {sum(self.averaged_shares):g}")

    def with_checkpoints(self, initial: Path | None, averaged: Sequence[Path]) -> TrainConfig:
        """The same, saying by name and SHA-256 which weights training starts from, and which are averaged in."""
        named = [_named(path) for path in averaged]
        return self.model_copy(update={"initial": initial and _named(initial), "averaged": tuple(named)})

    def with_steps(self, steps: int) -> TrainConfig:
        """The same for another number of steps."""
        content = self.model_dump(mode="json")
        content["training"]["steps"] = steps
        return TrainConfig.model_validate(content)


def _named(checkpoint: Path) -> str:
    return f"{checkpoint.name} sha256:{hashlib.sha256(checkpoint.read_bytes()).hexdigest()}"


def read_config(path: Path, overrides: Sequence[str] = ()) -> TrainConfig:
    """Read and check a YAML configuration.

    Parameters
    ----------
    path
        The file.
    overrides
        "KEY.KEY=VALUE" each, the value as in YAML; they replace what the file says.

    Raises
    ------
    SkyfixError
        If the file is missing, is not YAML, or it or an override has unknown keys or wrong types.
    """
    if not path.is_file():
        raise SkyfixError(f"config: expected a YAML file at {path}, got no such file")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise SkyfixError(f"config {path.name}: expected YAML, got {str(error).splitlines()[0]}") from error
    if not isinstance(content, dict):
        raise SkyfixError(f"config {path.name}: expected a mapping, got {type(content).__name__}")
    for override in overrides:
        _override(content, override)
    try:
        config = TrainConfig.model_validate(content)
        config.check()
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise SkyfixError(f"config {path.name}: {where}: {first['msg']}, got {first['input']!r}") from error
    except SkyfixError as error:
        raise SkyfixError(f"config {path.name}: {error}") from error
    return config


def write_config(config: TrainConfig, path: Path) -> None:
    """Write a configuration with every default filled in, such that `read_config` gives it back."""
    partial = path.with_suffix(".part")
    try:
        partial.write_text(yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False), encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise SkyfixError(f"{path}: cannot be written: {error.strerror}") from error


def first_difference(one: TrainConfig, other: TrainConfig) -> tuple[str, Any, Any] | None:
    """A key that decides on the result and differs, with both values; None if there is none."""
    a, b = (dotted(config.model_dump(mode="json")) for config in (one, other))
    for key in [*a, *(key for key in b if key not in a)]:
        if key not in _FREE_KEYS and a.get(key) != b.get(key):
            return key, a.get(key), b.get(key)
    return None


def _override(content: dict[str, Any], override: str) -> None:
    keys, value = split_override(override)
    inner = content
    for key in keys[:-1]:
        inner = inner.setdefault(key, {})
        if not isinstance(inner, dict):
            raise SkyfixError(f"--set {'.'.join(keys)}: expected a mapping at {key}, got {inner!r}")
    inner[keys[-1]] = value
