"""Checkpoints: weights as safetensors, everything else as JSON beside them. Nothing in one is ever unpickled."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from fusion.errors import SkyfixError
from learned.calibration import Calibration
from learned.network import Architecture, LocalizationNet, NetworkMatcher


def save_network(
    path: Path,
    architecture: Architecture,
    net: LocalizationNet,
    calibration: Calibration,
    provenance: dict[str, object],
) -> None:
    """Write PATH (.safetensors) and the .json beside it; `provenance`: data, seed and command."""
    facts = {
        "architecture": architecture.tag,
        "settings": asdict(net.settings),
        "calibration": asdict(calibration),
        "parameters": sum(p.numel() for p in net.parameters()),
        **provenance,
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        save_file({name: tensor.cpu().contiguous() for name, tensor in net.state_dict().items()}, path)
        path.with_suffix(".json").write_text(json.dumps(facts, indent=2) + "\n")
    except OSError as error:
        raise SkyfixError(f"checkpoint {path}: cannot be written: {error.strerror or error}") from error


def load_network(path: Path, architecture: Architecture) -> tuple[Any, Calibration]:
    """Read a checkpoint of a known architecture: weights in PATH (.safetensors), the rest in the .json beside it.

    Raises
    ------
    SkyfixError
        If a file is missing or unreadable, or was written for another architecture or other sizes.
    """
    from learned.architectures import settings_from

    facts = _facts(path)
    try:
        if facts["architecture"] != architecture.tag:
            raise SkyfixError(
                f"checkpoint {path.name}: expected architecture {architecture.tag}, got {facts['architecture']}"
            )
        settings = settings_from(architecture, facts["settings"])
        calibration = Calibration(**facts["calibration"])
        weights = load_file(path)
    except (KeyError, TypeError, SafetensorError) as error:
        raise SkyfixError(f"checkpoint {path.name}: expected a readable checkpoint, got {error!r}") from error
    try:
        net = architecture.build(settings)
    except (ValueError, RuntimeError, TypeError, ArithmeticError) as error:  # what torch makes of impossible sizes
        raise SkyfixError(f"checkpoint {path.name}: its settings make no network: {error}") from error
    try:
        net.load_state_dict(weights)
    except RuntimeError as error:
        what = str(error).splitlines()[-1].strip()
        raise SkyfixError(f"checkpoint {path.name}: its weights do not fit its stated sizes: {what}") from error
    return net, calibration


@dataclass(frozen=True, slots=True)
class InitialWeights:
    """Weights that a training starts from.

    Attributes
    ----------
    weights
        By the parameters' names.
    is_part
        They are those of some modules, and the others start afresh; otherwise they have to be all.
    """

    weights: Mapping[str, Tensor]
    is_part: bool = False


def load_initial(path: Path, architecture: Architecture) -> InitialWeights:
    """What a checkpoint holds to start a training of an architecture from.

    Raises
    ------
    SkyfixError
        If it is neither of that architecture nor of one that pre-trains it, or as `load_network`.
    """
    from learned.architectures import architecture_named

    before = str(_facts(path).get("architecture")).rpartition("-")[0]
    if before not in architecture.pretrained_by:
        return InitialWeights(load_network(path, architecture)[0].state_dict())
    modules = architecture.pretrained_by[before]
    weights = load_network(path, architecture_named(before))[0].state_dict()
    return InitialWeights({name: each for name, each in weights.items() if name.split(".")[0] in modules}, is_part=True)


def load_checkpoint(path: Path) -> NetworkMatcher:
    """Read a checkpoint of any architecture in `learned.architectures.ARCHITECTURES` as a matcher.

    Raises
    ------
    SkyfixError
        As `load_network`, and if this version has no such architecture.
    """
    from learned.architectures import ARCHITECTURES

    tag = str(_facts(path).get("architecture"))
    by_tag = {architecture.tag: architecture for architecture in ARCHITECTURES.values()}
    if tag not in by_tag:
        raise SkyfixError(f"checkpoint {path.name}: expected architecture {' or '.join(by_tag)}, got {tag}")
    return by_tag[tag].matcher(*load_network(path, by_tag[tag]))


def _facts(path: Path) -> dict[str, Any]:
    sidecar = path.with_suffix(".json")
    for file in (path, sidecar):
        if not file.is_file():
            raise SkyfixError(f"checkpoint: expected {file.name} at {file.parent}, got no such file")
    try:
        facts = json.loads(sidecar.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise SkyfixError(f"checkpoint {path.name}: expected a readable checkpoint, got {error!r}") from error
    if not isinstance(facts, dict):
        raise SkyfixError(f"checkpoint {path.name}: expected a JSON object in {sidecar.name}, got {type(facts)}")
    return facts
