"""Batches by number: a function of the seed and the step alone, whoever makes them and wherever training starts."""

from __future__ import annotations

import ctypes
import signal
import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import DataLoader
from torch.utils.data import Dataset as TorchDataset

from fusion.errors import SkyfixError
from learned.network import Batch
from learned.processes import ALONE, Processes
from learned.samples import Augmentation, Example, Sample, augment
from learned.training_settings import TrainingSettings

_PR_SET_PDEATHSIG = 1


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


class _Steps(TorchDataset[list[Example]]):
    """Step -> this process's part of the step's batch, augmented.

    Examples leave a worker as numpy arrays, through a pipe: as tensors they would go through shared memory, of which
    containers often have little.
    """

    def __init__(self, source: SampleSource, settings: TrainingSettings, first: int, processes: Processes) -> None:
        self.source, self.settings, self.first = source, settings, first
        self.share = settings.batch // processes.count
        self.offset = self.share * processes.rank
        self.epoch, self.order = -1, np.zeros(0, dtype=np.int64)

    def __len__(self) -> int:
        return self.settings.steps - self.first

    def __getitem__(self, index: int) -> list[Example]:
        start = (self.first + index) * self.settings.batch + self.offset
        return [self._example(position) for position in range(start, start + self.share)]

    def _example(self, position: int) -> Example:
        epoch, within = divmod(position, len(self.source))
        if epoch != self.epoch:
            self.epoch = epoch
            self.order = self.source.order(np.random.default_rng((self.settings.seed, 1, epoch)))
        rng = np.random.default_rng((self.settings.seed, 2, position))
        return augment(self.source[int(self.order[within])], rng, self.settings.augmentation)


def training_batches(
    source: SampleSource, settings: TrainingSettings, first: int, processes: Processes = ALONE
) -> Iterator[Batch]:
    """The batches of the steps from `first` on; of several processes each gets its share of every batch.

    Raises
    ------
    SkyfixError
        If there are no samples, or the batch cannot be shared evenly.
    """
    if len(source) == 0:
        raise SkyfixError("training: expected at least one sample, got none")
    if settings.batch % processes.count:
        raise SkyfixError(
            f"training batch: expected a multiple of the {processes.count} processes, got {settings.batch}"
        )
    steps, workers = _Steps(source, settings, first, processes), settings.workers
    loader = DataLoader(
        steps,
        batch_size=None,
        num_workers=workers,
        prefetch_factor=8 if workers else None,
        worker_init_fn=_end_with_parent,
        multiprocessing_context=_context() if workers else None,
    )
    for examples in loader:
        yield Batch.of(examples, steps.offset)


def _context() -> str | None:
    """How workers start: as the platform does, but never as a fork of a process with OpenVINO, which dies of it."""
    return "forkserver" if "openvino" in sys.modules and sys.platform == "linux" else None


def _end_with_parent(worker: int) -> None:
    """Ask Linux to end a worker when its parent is killed: it could wait forever to hand over a batch."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def validation_batch(source: SampleSource, index: int, settings: TrainingSettings) -> Batch:
    """One sample of a held-out source without impoverishment, at an offset that is always the same."""
    return Batch.of([augment(source[index], np.random.default_rng((settings.seed, 3, index)), _plain(settings))])


def _plain(settings: TrainingSettings) -> Augmentation:
    return replace(
        settings.augmentation,
        drop_class=0.0,
        thin=0.0,
        shorten=0.0,
        drop_sector=0.0,
        drop_band=0.0,
        rotate=0.0,
        colour_jitter=0.0,
    )
