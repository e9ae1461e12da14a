"""`skyfix ablate CONFIG`: which part of a network earns its place, over several seeds, in one table.

Every variant is trained with every seed on the same simulated samples for the same number of steps, calibrated as
`skyfix train` does, and scored by single shots on held-out simulated samples that calibration has not seen, and on
the sequences given. Seeds are the outer loop, and the tables are written anew after every run: they are of use before
the last run is done.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fusion.errors import SkyfixError
from learned.network import NetworkMatcher
from learned.samples import Sample
from learned.training import Progress, make_folder
from sequences.ablation_config import Ablation, read_ablation
from sequences.ablation_run import NETWORK, FinishedRun, Run, Task, evaluate_run, is_finished, train_run
from sequences.ablation_tables import write_tables
from sequences.evaluate import evaluate_samples, evaluate_single_shot
from sequences.held_out import evaluation_settings
from sequences.sequence import Sequence as Drive
from sequences.shot_protocol import ShotProtocol
from sequences.train_command import find_extract
from sequences.train_config import RESOLVED_FILE, TrainConfig, read_config
from sequences.training_data import SimulatedSamples

SIMULATED = "held-out simulation"


@dataclass(frozen=True, slots=True)
class AblateOptions:
    """How to run an ablation, as opposed to what is varied.

    Attributes
    ----------
    seeds
        Of the trainings; samples are the same for all.
    minutes
        Choose the number of steps so that the first run takes about so long; all take as many. None: as configured.
    cache_dir
        Where samples are kept, also for other runs; None: in the output folder.
    overrides
        "KEY.KEY=VALUE" each, changed in the base for all variants.
    half_extent_m, half_headings_deg, max_frames
        Starts of the single shots, see `sequences.shot_protocol`. Left out, the heading is known to within what the
        base trains for; wider than a variant that needs the heading trains for is refused.
    """

    seeds: Sequence[int] = (0,)
    minutes: float | None = None
    cache_dir: Path | None = None
    overrides: Sequence[str] = ()
    half_extent_m: float = 20.0
    half_headings_deg: Sequence[float] = ()
    max_frames: int = 200

    def __post_init__(self) -> None:
        if not self.seeds or len(set(self.seeds)) != len(self.seeds) or min(self.seeds) < 0:
            raise SkyfixError(f"--seeds: expected distinct numbers of zero or more, got {list(self.seeds)}")


def ablate(
    path: Path,
    data_dir: Path,
    out_dir: Path,
    sequences: Sequence[Drive] = (),
    options: AblateOptions | None = None,
    progress: Progress | None = None,
    report: Callable[[str], None] = lambda line: None,
) -> Path:
    """Train and score every variant with every seed; goes on where it was stopped.

    Parameters
    ----------
    path
        YAML, see `sequences.ablation_config`.
    data_dir
        Folder that the extracts' paths are relative to.
    out_dir
        Gets runs/VARIANT/seed-N, ablation.md, ablation.json and, without another, the cache of samples.
    sequences
        To score on besides, with ground truth.
    options
        See `AblateOptions`.
    progress, report
        Told of every step of a training, and of every run as it starts.

    Returns
    -------
    Path of ablation.md.

    Raises
    ------
    SkyfixError
        If a variant is none, `out_dir` cannot be written or holds runs with other settings, or a training fails.
    """
    options = options or AblateOptions()
    ablation = read_ablation(path, options.overrides)
    names = [sequence.name for sequence in sequences]
    if len({SIMULATED, *names}) != len(names) + 1:
        raise SkyfixError(f"--evaluate: expected sequences of distinct names, got {', '.join(names)}")
    if options.minutes is not None and any("training.steps" in variant.changes for variant in ablation.variants):
        raise SkyfixError("--minutes: expected variants that leave training.steps alone, got one that sets it")
    scores = _Scores(ablation, data_dir, sequences, options)
    make_folder(out_dir)
    runs = _runs(ablation, options, out_dir)
    finished: list[FinishedRun] = []
    for number, run in enumerate(runs, start=1):
        report(f"{run.label} ({number} of {len(runs)}){': trained already' if is_finished(run) else ''}")
        minutes = options.minutes
        if minutes is not None and number > 1:
            steps = read_config(runs[0].folder / RESOLVED_FILE).training.steps
            run, minutes = replace(run, overrides=(*run.overrides, f"training.steps={steps}")), None
        facts = train_run(run, data_dir, minutes, progress)
        evaluations = evaluate_run(run, facts.pop("checkpoint"), scores.tasks(run))
        finished.append(FinishedRun(run, **facts, evaluations=evaluations))
        write_tables(out_dir, ablation, finished, len(runs))
    return out_dir / "ablation.md"


def _runs(ablation: Ablation, options: AblateOptions, out_dir: Path) -> list[Run]:
    cache = options.cache_dir or out_dir / "cache"
    base = read_config(ablation.base, options.overrides)
    runs = []
    for seed in options.seeds:
        for variant in ablation.variants:
            overrides = (*options.overrides, *variant.overrides, f"training.seed={seed}")
            folder = out_dir / "runs" / variant.folder / f"seed-{seed}"
            shared = _simulated_as(variant.config) == _simulated_as(base)
            runs.append(
                Run(variant, seed, ablation.base, overrides, folder, cache if shared else cache / variant.folder)
            )
    return runs


def _simulated_as(config: TrainConfig) -> tuple[Any, ...]:
    """What decides on the samples; of two that agree in it the runs share a cache."""
    return config.extracts, config.validation_extract, replace(config.simulation, samples=0), config.matching_reach_m


class _Scores:
    """What every run is scored on; the held-out samples are made, or read, when first asked for."""

    def __init__(self, ablation: Ablation, data_dir: Path, sequences: Sequence[Drive], options: AblateOptions) -> None:
        self._samples_wanted, self._data_dir, self._sequences = ablation.evaluation_samples, data_dir, sequences
        own = read_config(ablation.base, options.overrides).training.augmentation.half_heading_deg
        headings = dict.fromkeys(options.half_headings_deg or (own,))
        self._protocols = [ShotProtocol(options.half_extent_m, each, options.max_frames) for each in headings]
        for variant in ablation.variants:
            known = variant.config.training.known_half_heading_deg
            if max(headings) > known:
                raise SkyfixError(
                    f"--half-heading-deg: expected at most {known:g}, what variant {variant.name!r} is trained for, "
                    f"got {max(headings):g}"
                )
        self._held: tuple[Path, list[Sample]] | None = None

    def tasks(self, run: Run) -> list[Task]:
        """The evaluations of a run: the simulated ones first."""
        tasks = []
        for protocol in self._protocols:
            simulated = replace(protocol, max_frames=self._samples_wanted)

            def on_samples(matcher: NetworkMatcher, protocol: ShotProtocol = simulated) -> dict[str, Any]:
                samples = self._samples(run, protocol.half_extent_m)
                return evaluate_samples(SIMULATED, samples, {NETWORK: matcher}, protocol)

            tasks.append(Task({"sequence": SIMULATED, **simulated.stated()}, on_samples))
        for sequence in self._sequences:
            for protocol in self._protocols:

                def on_drive(
                    matcher: NetworkMatcher, sequence: Drive = sequence, protocol: ShotProtocol = protocol
                ) -> dict[str, Any]:
                    return evaluate_single_shot(sequence, {NETWORK: matcher}, protocol)

                tasks.append(Task({"sequence": sequence.name, **protocol.stated()}, on_drive))
        return tasks

    def _samples(self, run: Run, half_extent_m: float) -> list[Sample]:
        folder = run.cache_dir / f"evaluation_{half_extent_m:g}m"
        if self._held is None or self._held[0] != folder:
            config = run.variant.config
            extracts = [(find_extract(config.validation_extract, self._data_dir), 1.0)]
            settings = evaluation_settings(config, self._samples_wanted, half_extent_m)
            source = SimulatedSamples(extracts, settings, folder)
            self._held = folder, [source[index] for index in range(len(source))]
        return self._held[1]
