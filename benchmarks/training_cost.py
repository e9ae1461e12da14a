"""CPU time and peak of memory of a training step of TransLocNet on one thread, in a process of its own.

Run it as ``python -m benchmarks.training_cost``: memory that was ever used counts, so nothing else may run before.
"""

from __future__ import annotations

import math
import resource
import time

import torch

from benchmarks.translocnet import FULL, SEED, example_batch, training_step
from learned.translocnet import TransLocNet
from learned.translocnet_settings import TransLocNetSettings


def training_cost(settings: TransLocNetSettings, runs: int) -> tuple[float, float]:
    """CPU seconds (least of the runs) of a training step, and the process's peak of memory so far, MB."""
    torch.manual_seed(SEED)
    net, batch = TransLocNet(settings), example_batch(settings)
    least = math.inf
    for _ in range(runs):
        start = time.process_time()
        training_step(net, batch)
        least = min(least, time.process_time() - start)
    return least, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    torch.set_num_threads(1)
    seconds, megabytes = training_cost(FULL, 5)
    print(
        f"training step of one sample, one thread: {seconds:.2f} CPU s (least of 5), peak of memory {megabytes:.0f} MB"
    )
