"""Several training processes as one: what torchrun starts, joined through gloo.

Each process computes the gradient of its share of every batch and DistributedDataParallel averages them (Li et al.,
"PyTorch Distributed", VLDB 2020); the first process alone validates and writes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch import distributed as dist
from torch.nn.parallel import DistributedDataParallel

from fusion.errors import SkyfixError
from learned.network import Batch, LocalizationNet


@dataclass(frozen=True, slots=True)
class Processes:
    """This process's number among those that train together."""

    rank: int = 0
    count: int = 1

    @property
    def is_first(self) -> bool:
        """Whether this one validates and writes."""
        return self.rank == 0

    def wait(self) -> None:
        """Until all have come here."""
        if self.count > 1:
            dist.barrier()

    def mean(self, values: Tensor) -> Tensor:
        """The mean over the processes."""
        if self.count == 1:
            return values
        total = values.detach().clone()
        dist.all_reduce(total)
        return total / self.count

    def told_by_first(self, value: int) -> int:
        """The first process's value, in all of them."""
        if self.count == 1:
            return value
        told = torch.tensor([value])
        dist.broadcast(told, 0)
        return int(told)

    def objective(self, net: LocalizationNet) -> Callable[[Batch, torch.Generator], dict[str, Tensor]]:
        """The network's losses, whose gradients `backward` averages over the processes."""
        if self.count == 1:
            return net.losses
        return DistributedDataParallel(_Objective(net))


ALONE = Processes()


class _Objective(nn.Module):
    """The losses as a module's forward, which is where DistributedDataParallel hooks in."""

    def __init__(self, net: LocalizationNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, batch: Batch, generator: torch.Generator) -> dict[str, Tensor]:
        return self.net.losses(batch, generator)


def rows_of_all(rows: Tensor) -> Tensor:
    """The rows (B, ...) of all processes that train together, in order: (count B, ...); alone, the rows themselves.

    A loss of them is the same in every process, but has a gradient in this one's rows only. That counts `count` times,
    so that the average over the processes is the gradient of the loss.
    """
    if not (dist.is_initialized() and torch.is_grad_enabled()):
        return rows
    count, own = dist.get_world_size(), rows.detach().cpu().contiguous()  # gloo gathers on the CPU alone
    gathered = [torch.empty_like(own) for _ in range(count)]
    dist.all_gather(gathered, own)
    parts = [part.to(rows.device) for part in gathered]
    if rows.requires_grad:
        parts[dist.get_rank()] = count * rows - (count - 1) * rows.detach()
    return torch.cat(parts)


@contextmanager
def joined_processes(environment: Mapping[str, str] = os.environ) -> Iterator[Processes]:
    """Join the processes that torchrun has started together (it sets RANK, WORLD_SIZE and where to meet).

    Raises
    ------
    SkyfixError
        If they cannot meet.
    """
    count = int(environment.get("WORLD_SIZE", "1"))
    if count <= 1:
        yield ALONE
        return
    try:
        dist.init_process_group("gloo")
    except (ValueError, RuntimeError) as error:
        raise SkyfixError(f"training processes: {count} cannot meet: {str(error).splitlines()[0]}") from error
    try:
        yield Processes(dist.get_rank(), count)
    finally:
        dist.destroy_process_group()
