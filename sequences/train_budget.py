"""How many steps fit into a number of minutes, from a few that are timed first.

The learning rate's schedule counts steps, so that a run can be made again; a budget in minutes is turned into steps
once, at the start, and the number is kept in the run's configuration.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import cycle, islice

import numpy as np
import torch

from fusion.errors import SkyfixError
from learned.batches import validation_batch
from learned.network import Batch
from learned.samples import augment
from learned.training_settings import TrainingSettings
from learned.training_state import TrainingState
from sequences.training_data import SimulatedSamples

_WARM_UP = 2
_TIMED = 4


def steps_within(
    minutes: float, source: SimulatedSamples, validation: SimulatedSamples, settings: TrainingSettings
) -> int:
    """The number of steps that training takes about so many minutes for, calibration not counted.

    Counted are the steps themselves, the validations and the samples that are not in the caches yet; with workers,
    steps and samples are made side by side.

    Raises
    ------
    SkyfixError
        If the minutes are not above zero or not even one step fits.
    """
    if not minutes > 0:
        raise SkyfixError(f"--minutes: expected above zero, got {minutes:g}")
    area_s, missing = _area_seconds(source), len(source.missing_areas())
    step_s, example_s = _step_seconds(source, validation, settings)
    first_s = len(validation.missing_areas()) * area_s

    def seconds(steps: int) -> float:
        share_made = min(1.0, steps * settings.batch / len(source))
        making = missing * share_made * area_s
        stepping = steps * step_s
        validations = -(-steps // settings.validate_every) * len(validation) * example_s
        together = max(making / settings.workers, stepping) if settings.workers else making + stepping
        return first_s + together + validations

    steps = _most(seconds, 60.0 * minutes)
    if steps < 1:
        raise SkyfixError(f"--minutes: expected at least {seconds(1) / 60:.1f} for a single step, got {minutes:g}")
    return steps


def _most(seconds: Callable[[int], float], budget_s: float) -> int:
    """The largest number of steps within a budget, by bisection."""
    low, high = 0, 1
    while seconds(high) <= budget_s:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if seconds(middle) <= budget_s else (low, middle)
    return low


def _area_seconds(source: SimulatedSamples) -> float:
    """Time to make a neighbourhood's samples, the faster of two that are missing; zero if none is."""
    times = []
    for number in source.missing_areas()[:2]:
        began = time.perf_counter()
        source.area(number)
        times.append(time.perf_counter() - began)
    return min(times, default=0.0)


def _step_seconds(
    source: SimulatedSamples, validation: SimulatedSamples, settings: TrainingSettings
) -> tuple[float, float]:
    """Median time of a step, examples included, and of validating one sample."""
    state = TrainingState(settings, settings.torch_device())
    device = next(iter(state.net.parameters())).device
    samples = source.area(0)
    steps, validations = [], []
    state.net.train()
    for number in range(_WARM_UP + _TIMED):
        began = time.perf_counter()
        rng, generator = np.random.default_rng(number), torch.Generator().manual_seed(number)
        chosen = islice(cycle(samples), number, number + settings.batch)
        batch = Batch.of([augment(sample, rng, settings.augmentation) for sample in chosen]).to(device)
        with torch.autocast(device.type, torch.bfloat16, enabled=settings.uses_bfloat16(device)):
            total = state.net.losses(batch, generator)["total"]
        state.advance(total)
        steps.append(time.perf_counter() - began)
    state.net.eval()
    validation.area(0)
    for index in range(_TIMED):
        batch = validation_batch(validation, index % len(validation), settings).to(device)
        began = time.perf_counter()
        with torch.inference_mode():
            float(state.net.truth_nll(batch, torch.Generator().manual_seed(index)))
        validations.append(time.perf_counter() - began)
    return float(np.median(steps[_WARM_UP:])), float(np.median(validations))
