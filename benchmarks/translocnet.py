"""TransLocNet on one core: an answer, and a training step of one sample (forward and backward).

Beside it runs a matrix product of as many multiplications: what the machine can do at best at that moment, whatever
else it does. The rotated-template matcher answers the same question about the same scan, over all headings.

``python -m benchmarks.training_cost`` measures CPU time and memory of a training step, which this table cannot hold.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.runner import Candidate, Case
from learned.network import Batch, LocalizationNet
from learned.rotmatch import RotMatchNet, RotMatchSettings
from learned.translocnet import TransLocNet
from learned.translocnet_settings import CompactSettings, TransLocNetSettings

SEED = 0
FULL = TransLocNetSettings()
COMPACT = CompactSettings()
_MATRIX_SIDE = 512


def example_batch(settings: TransLocNetSettings) -> Batch:
    """One sample of noise."""
    generator = torch.Generator().manual_seed(SEED)
    size, crop = settings.bev.size, settings.crop_px
    density = torch.rand(1, 4, size, size, generator=generator)
    picture = torch.rand(1, 3, crop, crop, generator=generator)
    middle, heading = (torch.full((1,), value, dtype=torch.float64) for value in (0.45 * crop, 0.3))
    return Batch(density, picture, middle, middle, heading, heading + 0.1)


def answer(net: LocalizationNet, batch: Batch) -> None:
    """Density of one pose: every feature is computed, and the headings where they are asked for."""
    with torch.inference_mode():
        net.truth_nll(batch, torch.Generator().manual_seed(SEED))


def training_step(net: LocalizationNet, batch: Batch) -> None:
    """Loss and gradients."""
    net.losses(batch, torch.Generator().manual_seed(SEED))["total"].backward()


def multiplications(work: Callable[[], None]) -> int:
    """Multiply-adds of the convolutions and matrix products of some work."""
    with FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops() // 2


def matrix_products(count: int) -> Callable[[], None]:
    """Products of square matrices with about `count` multiply-adds in all."""
    matrix = torch.rand(_MATRIX_SIDE, _MATRIX_SIDE)
    repeats = max(1, round(count / _MATRIX_SIDE**3))

    def work() -> None:
        for _ in range(repeats):
            torch.mm(matrix, matrix)

    return work


def cases(settings: Sequence[TransLocNetSettings] = (FULL, COMPACT)) -> Iterator[Case]:
    """An answer and a training step of every size; the size of a case is the crop's side in pixels."""
    for sizes in settings:
        yield from _cases(sizes)


def _cases(settings: TransLocNetSettings) -> Iterator[Case]:
    torch.manual_seed(SEED)
    net, batch = TransLocNet(settings), example_batch(settings)
    voting = RotMatchNet(RotMatchSettings(bev=settings.bev))
    millions = sum(p.numel() for p in net.parameters()) / 1e6
    works: tuple[tuple[str, Callable[[LocalizationNet, Batch], None]], ...] = (
        ("answer", answer),
        ("training step", training_step),
    )
    for what, work in works:
        ours, theirs = partial(work, net, batch), partial(work, voting, batch)
        count = multiplications(ours)
        products = matrix_products(count)
        candidates = (
            Candidate(f"skyfix TransLocNet, {millions:.1f} M parameters", partial(_again, ours)),
            Candidate("skyfix RotMatch, 21 headings", partial(_again, theirs)),
            Candidate(f"torch.mm of the same {count / 1e9:.2g} billion multiply-adds", partial(_again, products)),
        )
        yield Case(f"TransLocNet {millions:.1f} M: {what}", settings.crop_px, candidates)


def _again(work: Callable[[], None]) -> Callable[[], None]:
    """What a run needs is ready: networks keep no state of an answer, and gradients are added to those before."""
    return work
