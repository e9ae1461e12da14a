"""A training in a process of its own, for tests that kill it or run several: `python training_process.py OUT WHEN`.

WHEN says when it kills itself with SIGKILL: "never", "before 5" (as step 5 is done) or "writing 2" (the second state is
written but not in its place yet). With "together hybrid", under RANK and WORLD_SIZE, it trains a network with others.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import torch
from guess_network import GUESS, GuessSettings
from landmarks import Landmarks

from learned.architectures import ARCHITECTURES
from learned.hybrid import HybridSettings
from learned.processes import joined_processes
from learned.rotmatch import RotMatchSettings
from learned.training import NetworkChoice, TrainingSettings, train

ARCHITECTURES["guess"] = GUESS
KILLED = TrainingSettings(
    steps=9,
    batch=2,
    learning_rate=0.1,
    warmup_steps=2,
    validate_every=3,
    workers=1,
    ema_decay=0.5,
    network=NetworkChoice("guess", GuessSettings(dropout=0.3)),
)
_TINY = {
    "rotmatch": RotMatchSettings(4, (4, 4, 8, 8)),
    "hybrid": HybridSettings(4, (4, 4, 8, 8), contrastive_weight=1.0, embedding=4),
}
TOGETHER = {
    name: TrainingSettings(
        steps=3,
        batch=4,
        warmup_steps=1,
        validate_every=1,
        workers=0,
        precision="float32",
        network=NetworkChoice(name, network),
    )
    for name, network in _TINY.items()
}


def kill_self(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def main(out: Path, when: str) -> None:
    torch.set_num_threads(1)
    moment, _, number = when.partition(" ")
    if moment == "together":
        with joined_processes() as processes:
            train(Landmarks(12), Landmarks(1), TOGETHER[number], out, processes=processes)
        return
    if moment == "writing":
        written = iter(range(1, 100))
        os.fsync = lambda _: kill_self() if next(written) == int(number) else None

    def progress(step: int, steps: int, loss: float, validation: float | None) -> None:
        if moment == "before" and step == int(number):
            kill_self()

    train(Landmarks(4), Landmarks(1), KILLED, out, progress)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
