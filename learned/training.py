"""Training RotMatch: a resumable loop over samples, with a loss curve and validation.

Everything random comes from the seed and the step: stopping and resuming gives the weights that going on would have
given.
"""

from __future__ import annotations

import csv
import math
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader
from torch.utils.data import Dataset as TorchDataset

from fusion.errors import SkyfixError
from learned.network import Batch
from learned.rotmatch import RotMatchNet, RotMatchSettings
from learned.samples import Augmentation, Example, Sample, augment


class SampleSource(Protocol):
    """Samples by index; the same index gives the same sample."""

    def __len__(self) -> int:
        """Number of samples."""
        ...

    def __getitem__(self, index: int) -> Sample:
        """The sample of an index."""
        ...

    def order(self, rng: np.random.Generator) -> NDArray[np.int64]:
        """An epoch's indices, shuffled as far as the source can afford."""
        ...


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """How to train.

    Attributes
    ----------
    steps, batch
        Optimizer steps, samples a step.
    learning_rate, weight_decay, warmup_steps, clip_norm
        AdamW with a linear warm-up and a cosine to zero; gradients clipped to a norm.
    validate_every
        Steps between validations and checkpoints.
    workers
        Processes that make samples beside the training (0: in the training process).
    """

    steps: int = 5000
    batch: int = 8
    learning_rate: float = 2e-3
    weight_decay: float = 1e-2
    warmup_steps: int = 100
    clip_norm: float = 1.0
    validate_every: int = 250
    seed: int = 0
    workers: int = 1
    network: RotMatchSettings = field(default_factory=RotMatchSettings)
    augmentation: Augmentation = field(default_factory=Augmentation)


class Progress(Protocol):
    """Told of each step, so that a caller can show it."""

    def __call__(self, step: int, steps: int, loss: float, validation: float | None) -> None:
        """`loss` is the step's mean NLL; `validation` the latest validation NLL, if any."""
        ...


class _Batches(TorchDataset[list[Example]]):
    """Batch number -> augmented examples; a function of the seed and the number alone."""

    def __init__(self, source: SampleSource, settings: TrainingSettings, first: int) -> None:
        self.source, self.settings, self.first = source, settings, first
        self.epoch, self.order = -1, np.zeros(0, dtype=np.int64)

    def __len__(self) -> int:
        return self.settings.steps - self.first

    def __getitem__(self, index: int) -> list[Example]:
        step = self.first + index
        batch = self.settings.batch
        examples = []
        for position in range(step * batch, (step + 1) * batch):
            epoch, within = divmod(position, len(self.source))
            if epoch != self.epoch:
                self.epoch = epoch
                self.order = self.source.order(np.random.default_rng((self.settings.seed, 1, epoch)))
            rng = np.random.default_rng((self.settings.seed, 2, position))
            examples.append(augment(self.source[int(self.order[within])], rng, self.settings.augmentation))
        return examples


def validation_nll(net: RotMatchNet, source: SampleSource, settings: TrainingSettings) -> float:
    """Mean NLL over all samples of a source, without impoverishment, at offsets that are always the same."""
    plain = Augmentation(settings.augmentation.max_offset_px, settings.augmentation.crop_px, 0.0, 0.0, 0.0, 0.0, 0.0)
    generator = torch.Generator().manual_seed(settings.seed)
    net.eval()
    losses = []
    with torch.inference_mode():
        for index in range(len(source)):
            example = augment(source[index], np.random.default_rng((settings.seed, 3, index)), plain)
            losses.append(float(net.truth_nll(Batch.of([example]), generator)))
    net.train()
    return float(np.mean(losses))


def train(
    source: SampleSource,
    validation: SampleSource,
    settings: TrainingSettings,
    out_dir: Path,
    progress: Progress | None = None,
) -> RotMatchNet:
    """Train a network, resuming from OUT_DIR/state.pt where there is one.

    Writes state.pt (weights, optimizer, step) and a row of loss.csv at every validation.

    Raises
    ------
    SkyfixError
        If the state in OUT_DIR was made with other settings.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(settings.seed)
    net = RotMatchNet(settings.network)
    optimizer = torch.optim.AdamW(net.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay)
    first = _resume(out_dir / "state.pt", net, optimizer, settings)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: _rate(step, settings), last_epoch=first - 1)
    recent: list[float] = []
    checked: float | None = None
    started = time.monotonic()
    net.train()
    for step, examples in enumerate(_batches(source, settings, first), start=first):
        generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + step)
        with torch.autocast("cpu", torch.bfloat16):
            loss = net.losses(Batch.of(examples), generator)["total"]
        if not torch.isfinite(loss):
            raise SkyfixError(f"training: expected a finite loss, got {float(loss)} at step {step}")
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), settings.clip_norm)
        optimizer.step()
        schedule.step()
        recent.append(loss.item())
        done = step + 1
        if done % settings.validate_every == 0 or done == settings.steps:
            checked = validation_nll(net, validation, settings)
            _append_row(out_dir / "loss.csv", done, float(np.mean(recent)), checked, time.monotonic() - started)
            _save_state(out_dir / "state.pt", net, optimizer, settings, done)
            recent = []
        if progress is not None:
            progress(done, settings.steps, loss.item(), checked)
    return net


def _batches(source: SampleSource, settings: TrainingSettings, first: int) -> Iterator[list[Example]]:
    loader = DataLoader(
        _Batches(source, settings, first),
        batch_size=None,
        num_workers=settings.workers,
        prefetch_factor=8 if settings.workers else None,
    )
    yield from loader


def _rate(step: int, settings: TrainingSettings) -> float:
    """Linear warm-up, then a cosine to zero, as a factor of the learning rate."""
    warm = min(1.0, (step + 1) / settings.warmup_steps)
    return warm * 0.5 * (1 + math.cos(math.pi * min(step / settings.steps, 1.0)))


def _resume(path: Path, net: RotMatchNet, optimizer: torch.optim.Optimizer, settings: TrainingSettings) -> int:
    if not path.exists():
        return 0
    state = torch.load(path, weights_only=True)
    if state["settings"] != repr(asdict(settings)):
        raise SkyfixError(f"training: {path.name} was made with other settings; choose another output folder")
    net.load_state_dict(state["net"])
    optimizer.load_state_dict(state["optimizer"])
    return int(state["step"])


def _save_state(
    path: Path, net: RotMatchNet, optimizer: torch.optim.Optimizer, settings: TrainingSettings, step: int
) -> None:
    partial = path.with_suffix(".part")
    torch.save(
        {
            "net": net.state_dict(),
            "optimizer": optimizer.state_dict(),
            "settings": repr(asdict(settings)),
            "step": step,
        },
        partial,
    )
    partial.replace(path)


def _append_row(path: Path, step: int, loss: float, validation: float, seconds: float) -> None:
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.writer(file)
        if new:
            writer.writerow(["step", "train_nll", "validation_nll", "seconds"])
        writer.writerow([step, f"{loss:.4f}", f"{validation:.4f}", f"{seconds:.0f}"])
