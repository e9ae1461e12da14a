"""CPU time and peak of memory of a training step of TransLocNet on one thread, in a process of its own.

Run it as ``python -m benchmarks.training_cost [float32]``: memory that was ever used counts, so a process measures one
precision: that of `skyfix train`, bfloat16 where operations allow it, or float32.
"""

from __future__ import annotations

import math
import resource
import sys
import time

import torch

from benchmarks.translocnet import FULL, SEED, example_batch
from learned.translocnet import TransLocNet
from learned.translocnet_settings import TransLocNetSettings


def training_cost(settings: TransLocNetSettings, runs: int, bfloat16: bool) -> tuple[float, float]:
    """CPU seconds (least of the runs) of a training step, and the process's peak of memory so far, MB."""
    torch.manual_seed(SEED)
    net, batch = TransLocNet(settings), example_batch(settings)
    least = math.inf
    for _ in range(runs):
        start = time.process_time()
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            loss = net.losses(batch, torch.Generator().manual_seed(SEED))["total"]
        loss.backward()
        least = min(least, time.process_time() - start)
    return least, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    torch.set_num_threads(1)
    precision = "float32" if "float32" in sys.argv[1:] else "bfloat16"
    seconds, megabytes = training_cost(FULL, 5, precision == "bfloat16")
    print(
        f"a training step of one sample, one thread, {precision}: {seconds:.2f} CPU s (least of 5), {megabytes:.0f} MB"
    )
