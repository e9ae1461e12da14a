"""What a training run is at a step, on disk: written whole or not at all, so that a kill at any moment costs at most
the steps since the last write.
"""

from __future__ import annotations

import copy
import io
import os
import pickle
from dataclasses import asdict, replace
from pathlib import Path

import torch
from torch import Tensor

from fusion.errors import SkyfixError
from learned.checkpoint import InitialWeights
from learned.network import LocalizationNet
from learned.training_settings import TrainingSettings


class TrainingState:
    """Weights, their moving average, optimizer and step.

    Parameters
    ----------
    settings
        What is trained, and how; the weights are drawn from its seed.
    device
        Where.
    """

    def __init__(self, settings: TrainingSettings, device: torch.device) -> None:
        torch.manual_seed(settings.seed)
        self.settings = settings
        self.net = settings.network.build()
        self.net.to(device)
        self.average = copy.deepcopy(self.net) if settings.ema_decay is not None else None
        rate, decay = settings.learning_rate, settings.weight_decay
        self.optimizer = torch.optim.AdamW(self.net.parameters(), lr=rate, weight_decay=decay)
        self.step = 0

    @property
    def evaluated(self) -> LocalizationNet:
        """The network that is validated and kept: the moving average where there is one."""
        return self.net if self.average is None else self.average

    def start_from(self, initial: InitialWeights) -> None:
        """Take weights in place of fresh ones.

        Raises
        ------
        SkyfixError
            If they do not fit.
        """
        try:
            for net in (self.net, self.average):
                if net is not None:
                    others = net.state_dict() if initial.is_part else {}
                    net.load_state_dict({**others, **initial.weights})
        except RuntimeError as error:
            what = str(error).splitlines()[-1].strip()
            raise SkyfixError(f"training: the initial weights do not fit the network: {what}") from error

    def advance(self, total: Tensor) -> float:
        """One optimizer step down the gradient of a loss, clipped; returns the gradient's norm.

        Raises
        ------
        SkyfixError
            If the gradient is not finite; the weights stay as they were.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = self.settings.learning_rate * self.settings.rate(self.step)
        self.optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(total)
        norm = float(torch.nn.utils.clip_grad_norm_(self.net.parameters(), self.settings.clip_norm))
        if not norm < float("inf"):
            raise SkyfixError(f"training: expected a finite gradient, got a norm of {norm} at step {self.step}")
        self.optimizer.step()
        self.step += 1
        if self.average is not None and self.settings.ema_decay is not None:
            _follow(self.average, self.net, self.settings.ema_decay)
        return norm

    def save(self, path: Path) -> None:
        """Write everything to PATH; SkyfixError if that fails."""
        content = {
            "net": self.net.state_dict(),
            "average": None if self.average is None else self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "settings": _fingerprint(self.settings),
            "step": self.step,
        }
        buffer = io.BytesIO()
        torch.save(content, buffer)
        partial = path.with_suffix(".part")
        try:
            with partial.open("wb") as file:
                file.write(buffer.getbuffer())
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path)
        except OSError as error:
            raise SkyfixError(f"training: {path} cannot be written: {error.strerror}") from error

    def resume(self, path: Path) -> None:
        """Go on from PATH, if it is there.

        Raises
        ------
        SkyfixError
            If it is unreadable or was made with other settings.
        """
        if not path.exists():
            return
        try:
            content = torch.load(path, weights_only=True, map_location="cpu")
            made_with = content["settings"]
        except (OSError, RuntimeError, EOFError, KeyError, TypeError, pickle.UnpicklingError) as error:
            what = next(iter(str(error).splitlines()), type(error).__name__)
            raise SkyfixError(f"training: {path} cannot be read, delete it to start afresh: {what}") from error
        if made_with != _fingerprint(self.settings):
            raise SkyfixError(f"training: {path.name} was made with other settings; choose another output folder")
        self.net.load_state_dict(content["net"])
        if self.average is not None:
            self.average.load_state_dict(content["average"])
        self.optimizer.load_state_dict(content["optimizer"])
        self.step = int(content["step"])


def _fingerprint(settings: TrainingSettings) -> str:
    """Everything that decides on the weights; the number of workers does not."""
    return repr(asdict(replace(settings, workers=0)))


def _follow(average: LocalizationNet, net: LocalizationNet, decay: float) -> None:
    """Move every floating-point tensor of the average a little towards the network's; copy the others."""
    now = net.state_dict()
    for name, value in average.state_dict().items():
        if value.is_floating_point():
            value.lerp_(now[name], 1.0 - decay)
        else:
            value.copy_(now[name])
