"""One run of an ablation: a variant with a seed, trained by `skyfix train`'s own machinery and scored.

Its folder is a training's folder with finished.json (steps, parameters, CPU minutes), which says that training is
done, and evaluations.json. So a finished run is not trained again, and one that was interrupted goes on.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fusion.errors import SkyfixError
from learned.checkpoint import load_checkpoint
from learned.network import NetworkMatcher
from learned.training import Progress
from sequences.ablation_config import Variant
from sequences.train_command import TrainOptions, train_from_config
from sequences.train_config import RESOLVED_FILE, first_difference, read_config

NETWORK = "network"
"""The run's own network among an evaluation's methods."""
FINISHED_FILE, EVALUATIONS_FILE = "finished.json", "evaluations.json"
_CPU_FILE = "cpu.json"


@dataclass(frozen=True, slots=True)
class Run:
    """What to train.

    Attributes
    ----------
    variant, seed
        Which line of the table it counts for, and the training's seed.
    base
        The base configuration's file.
    overrides
        All changes to it: for all variants, the variant's and the seed.
    folder, cache_dir
        Of its results and of the samples, which it shares.
    """

    variant: Variant
    seed: int
    base: Path
    overrides: tuple[str, ...]
    folder: Path
    cache_dir: Path

    @property
    def label(self) -> str:
        """As messages call it."""
        return f"{self.variant.name}, seed {self.seed}"


@dataclass(frozen=True, slots=True)
class FinishedRun:
    """A trained network and its scores.

    Attributes
    ----------
    run
        What was trained.
    steps, parameters, cpu_minutes
        Optimizer steps; the network's size; processor time of training, validation and calibration, without that of
        the processes that make samples.
    evaluations
        As `sequences.evaluate` gives them, with the prior and the network.
    """

    run: Run
    steps: int
    parameters: int
    cpu_minutes: float
    evaluations: tuple[dict[str, Any], ...]


@dataclass(frozen=True, slots=True)
class Task:
    """An evaluation to make: what it is of, as its result will say, and how it is made."""

    request: dict[str, Any]
    evaluate: Callable[[NetworkMatcher], dict[str, Any]]


class _CpuClock:
    """Processor time of a run over all its starts; kept as often as the training's state is."""

    def __init__(self, path: Path, every: int, progress: Progress | None) -> None:
        self._path, self._every, self._progress = path, every, progress
        self._before = float(_read_json(path)["seconds"]) if path.exists() else 0.0
        self._began = time.process_time()

    def __call__(self, step: int, steps: int, loss: float, validation: float | None) -> None:
        if step % self._every == 0 or step == steps:
            _write_json(self._path, {"seconds": self.seconds})
        if self._progress is not None:
            self._progress(step, steps, loss, validation)

    @property
    def seconds(self) -> float:
        return self._before + time.process_time() - self._began


def is_finished(run: Run) -> bool:
    """Whether it has been trained."""
    return (run.folder / FINISHED_FILE).exists()


def train_run(run: Run, data_dir: Path, minutes: float | None, progress: Progress | None) -> dict[str, Any]:
    """Train a run unless it is finished.

    Parameters
    ----------
    run
        Which.
    data_dir
        Folder of the extracts.
    minutes
        Choose the number of steps to take about so long; of a run that is there already, it stays.
    progress
        Told of every step.

    Returns
    -------
    `checkpoint` (file name), `steps`, `parameters`, `cpu_minutes`.

    Raises
    ------
    SkyfixError
        If training fails, or the folder holds a run with other settings.
    """
    config = read_config(run.base, run.overrides)
    if is_finished(run):
        before = read_config(run.folder / RESOLVED_FILE)
        wanted = config if minutes is None else config.with_steps(before.training.steps)
        difference = first_difference(before, wanted)
        if difference is not None:
            key, was, now = difference
            raise SkyfixError(f"{run.folder}: was trained with {key} {was} and not {now}; choose another --out")
        return _read_json(run.folder / FINISHED_FILE)
    clock = _CpuClock(run.folder / _CPU_FILE, config.training.validate_every, progress)
    try:
        options = TrainOptions(run.overrides, minutes, run.cache_dir)
        checkpoint = train_from_config(run.base, data_dir, run.folder, clock, options)
    except SkyfixError as error:
        raise SkyfixError(f"{run.label}: {error}") from error
    facts = {
        "checkpoint": checkpoint.name,
        "steps": read_config(run.folder / RESOLVED_FILE).training.steps,
        "parameters": _read_json(checkpoint.with_suffix(".json"))["parameters"],
        "cpu_minutes": round(clock.seconds / 60.0, 3),
    }
    _write_json(run.folder / FINISHED_FILE, facts)
    return facts


def evaluate_run(run: Run, checkpoint: str, tasks: Sequence[Task]) -> tuple[dict[str, Any], ...]:
    """Make the evaluations that are not there yet; all of them, in the order of the tasks."""
    path = run.folder / EVALUATIONS_FILE
    kept: list[dict[str, Any]] = _read_json(path) if path.exists() else []
    results = []
    for task in tasks:
        found = next((each for each in kept if task.request.items() <= each.items()), None)
        if found is None:
            found = task.evaluate(load_checkpoint(run.folder / checkpoint))
            kept.append(found)
            _write_json(path, kept)
        results.append(found)
    return tuple(results)


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SkyfixError(f"{path}: expected JSON, delete it to make it anew: {error}") from error


def _write_json(path: Path, content: object) -> None:
    partial = path.with_suffix(".part")
    try:
        partial.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise SkyfixError(f"{path}: cannot be written: {error.strerror}") from error
