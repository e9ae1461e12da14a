"""Trainings that are killed, and trainings by several processes, come to what one undisturbed process comes to."""

from __future__ import annotations

import csv
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from guess_network import GUESS
from landmarks import Landmarks
from training_process import KILLED, TOGETHER

from fusion.errors import SkyfixError
from learned.architectures import ARCHITECTURES
from learned.batches import training_batches
from learned.processes import Processes
from learned.training import train

TESTS = Path(__file__).parent


def start(out: Path, when: str, **environment: str) -> subprocess.Popen[bytes]:
    paths = os.pathsep.join([str(TESTS), str(TESTS.parent)])
    command = [sys.executable, str(TESTS / "training_process.py"), str(out), when]
    return subprocess.Popen(command, env={**os.environ, "PYTHONPATH": paths, **environment})


def state_of(out: Path) -> dict[str, torch.Tensor]:
    state = torch.load(out / "state.pt", weights_only=True)
    return {f"{kind} {name}": value for kind in ("net", "average") for name, value in (state[kind] or {}).items()}


def test_a_killed_training_ends_as_if_nothing_had_happened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ARCHITECTURES, "guess", GUESS)
    train(Landmarks(4), Landmarks(1), KILLED, tmp_path / "straight")
    straight = state_of(tmp_path / "straight")
    killed = tmp_path / "killed"
    for when, step in (("before 5", 3), ("writing 1", 3)):
        assert start(killed, when).wait(timeout=240) == -signal.SIGKILL
        assert torch.load(killed / "state.pt", weights_only=True)["step"] == step
    assert (killed / "state.part").exists()
    assert len((killed / "loss.csv").read_text().splitlines()) == 1 + 2  # the killed run's row of step 6 is there
    train(Landmarks(4), Landmarks(1), KILLED, killed)
    for name, value in state_of(killed).items():
        assert value.numpy().tobytes() == straight[name].numpy().tobytes(), name
    curves = [list(csv.reader((out / "loss.csv").read_text().splitlines())) for out in (tmp_path / "straight", killed)]
    assert [row[:3] for row in curves[0]] == [row[:3] for row in curves[1]]


@pytest.mark.parametrize("network", TOGETHER)
def test_two_processes_have_the_loss_curve_of_one(network: str, tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    meeting = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": "2"}
    both = [start(tmp_path / "two", f"together {network}", RANK=str(rank), **meeting) for rank in range(2)]
    train(Landmarks(12), Landmarks(1), TOGETHER[network], tmp_path / "one")
    assert [process.wait(timeout=240) for process in both] == [0, 0]
    curves = []
    for name in ("one", "two"):
        with (tmp_path / name / "loss.csv").open() as file:
            rows = [dict(row) for row in csv.DictReader(file)]
        curves.append([[float(value) for key, value in row.items() if key != "seconds"] for row in rows])
    assert ("contrastive" in rows[0]) == (network == "hybrid")
    assert len(curves[0]) == TOGETHER[network].steps
    np.testing.assert_allclose(curves[1], curves[0], atol=2e-3)
    assert np.ptp(np.array(curves[0])[:, 1]) > 0.1  # the steps differ by more than that


def test_processes_share_out_every_batch_and_no_sample_twice() -> None:
    def truths(processes: Processes) -> list[list[float]]:
        settings = TOGETHER["rotmatch"]
        return [batch.yaw.tolist() for batch in training_batches(Landmarks(12), settings, 1, processes)]

    whole = truths(Processes())
    parts = [truths(Processes(rank, 2)) for rank in range(2)]
    assert [a + b for a, b in zip(*parts, strict=True)] == whole
    with pytest.raises(SkyfixError, match="expected a multiple of the 3 processes, got 4"):
        truths(Processes(0, 3))
