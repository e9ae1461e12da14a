"""Training any network of `learned.architectures`: a resumable loop over samples, with a loss curve and validation.

Everything random comes from the seed and the step: stopping (or being killed) and resuming gives the weights that
going on would have given.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryFile
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from fusion.errors import SkyfixError
from learned.batches import SampleSource, training_batches, validation_batch
from learned.checkpoint import InitialWeights
from learned.network import LocalizationNet
from learned.processes import ALONE, Processes
from learned.training_log import TrainingLog
from learned.training_settings import NetworkChoice, TrainingSettings
from learned.training_state import TrainingState

__all__ = ["NetworkChoice", "Progress", "SampleSource", "TrainingSettings", "ValidationView", "train"]

STATE_FILE = "state.pt"


class Progress(Protocol):
    """Told of each step, so that a caller can show it."""

    def __call__(self, step: int, steps: int, loss: float, validation: float | None) -> None:
        """`loss` is the step's loss; `validation` the latest validation NLL, if any."""
        ...


class ValidationView(Protocol):
    """Shown the network at each validation, so that a caller can draw what it does."""

    def __call__(self, step: int, net: LocalizationNet) -> None:
        """`net` is in evaluation mode."""
        ...


def validation_nll(net: LocalizationNet, source: SampleSource, settings: TrainingSettings) -> float:
    """Mean NLL over all samples of a source, without impoverishment, at offsets that are always the same."""
    generator = torch.Generator().manual_seed(settings.seed)
    device = next(iter(net.parameters())).device
    with torch.inference_mode():
        batches = (validation_batch(source, index, settings).to(device) for index in range(len(source)))
        return float(np.mean([float(net.truth_nll(batch, generator)) for batch in batches]))


def train(
    source: SampleSource,
    validation: SampleSource,
    settings: TrainingSettings,
    out_dir: Path,
    progress: Progress | None = None,
    *,
    processes: Processes = ALONE,
    tensorboard: bool = False,
    view: ValidationView | None = None,
    initial: InitialWeights | None = None,
) -> LocalizationNet:
    """Train a network, resuming from OUT_DIR/state.pt where there is one.

    Writes state.pt (weights, optimizer, step) and a row of loss.csv at every validation. Of several processes, which
    must share OUT_DIR, the first writes.

    Parameters
    ----------
    source, validation
        Samples to train on and held-out ones.
    settings
        The network and how to train it.
    out_dir
        Made where it is missing.
    progress, view
        Told of every step, and shown the network at every validation.
    processes
        The processes that train together, see `learned.processes.joined_processes`.
    tensorboard
        Also write OUT_DIR/tensorboard.
    initial
        Weights to start from, in place of fresh ones.

    Raises
    ------
    SkyfixError
        If OUT_DIR cannot be written, its state was made with other settings, or a loss is not finite.
    """
    make_folder(out_dir)
    state = TrainingState(settings, settings.torch_device(processes.rank))
    if initial is not None:
        state.start_from(initial)
    state.resume(out_dir / STATE_FILE)
    log = TrainingLog(out_dir, state.step, tensorboard) if processes.is_first else None
    processes.wait()
    objective = processes.objective(state.net)
    device = next(iter(state.net.parameters())).device
    checked: float | None = None
    state.net.train()
    for batch in training_batches(source, settings, state.step, processes):
        # For dropout and the like; a seed of its own for each process.
        torch.manual_seed(settings.step_seed(state.step) * processes.count + processes.rank)
        generator = torch.Generator().manual_seed(settings.step_seed(state.step))
        with torch.autocast(device.type, torch.bfloat16, enabled=settings.uses_bfloat16(device)):
            losses = objective(batch.to(device), generator)
        terms = _finite_terms(losses, processes, state.step)
        rate = settings.learning_rate * settings.rate(state.step)
        state.advance(losses["total"])
        done = state.step
        if log is not None:
            log.step(done, terms, rate)
            if done % settings.validate_every == 0 or done == settings.steps:
                state.evaluated.eval()
                checked = validation_nll(state.evaluated, validation, settings)
                log.validation(done, checked, rate)
                state.save(out_dir / STATE_FILE)
                if view is not None:
                    view(done, state.evaluated)
                state.net.train()
            if progress is not None:
                progress(done, settings.steps, terms["total"], checked)
    if log is not None:
        log.close()
    processes.wait()
    return state.evaluated


def make_folder(path: Path) -> None:
    """Make a folder that can be written to, or raise SkyfixError; several processes may do so at once."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=path).close()
    except OSError as error:
        raise SkyfixError(f"{path}: expected a folder to write to: {error.strerror}") from error


def _finite_terms(losses: dict[str, Tensor], processes: Processes, step: int) -> dict[str, float]:
    """The terms as numbers, means over the processes; SkyfixError if the total is not finite."""
    if "total" not in losses:
        raise SkyfixError(f"training: expected a loss named total, got {', '.join(losses) or 'none'}")
    means = processes.mean(torch.stack([term.detach().float() for term in losses.values()])).tolist()
    terms = dict(zip(losses, means, strict=True))
    if not np.isfinite(terms["total"]):
        others = ", ".join(f"{name} {value:g}" for name, value in terms.items() if name != "total")
        raise SkyfixError(
            f"training: expected a finite loss, got {terms['total']} at step {step}{others and f' ({others})'}"
        )
    return terms
