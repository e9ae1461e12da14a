"""How to train: the settings of `learned.training.train`, checked when they are made."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from pydantic import GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

from fusion.errors import SkyfixError
from learned.architectures import architecture_named, settings_from, settings_mapping
from learned.network import Architecture, LocalizationNet
from learned.samples import Augmentation


@dataclass(frozen=True, slots=True)
class NetworkChoice:
    """Which network, and its settings; written as one mapping `{architecture: NAME, ...settings}`.

    Attributes
    ----------
    name
        One of `learned.architectures.ARCHITECTURES`.
    settings
        Of the architecture's settings type; None: its defaults.
    """

    name: str = "rotmatch"
    settings: Any = None

    def __post_init__(self) -> None:
        expected = architecture_named(self.name).settings_type
        if self.settings is None:
            object.__setattr__(self, "settings", expected())
        if type(self.settings) is not expected:
            raise SkyfixError(f"network {self.name}: expected {expected.__name__}, got {type(self.settings).__name__}")

    @property
    def architecture(self) -> Architecture:
        """The kind of network."""
        return architecture_named(self.name)

    def build(self) -> LocalizationNet:
        """A network with fresh weights, drawn from torch's global generator."""
        return self.architecture.build(self.settings)

    @classmethod
    def parse(cls, content: NetworkChoice | Mapping[str, Any]) -> NetworkChoice:
        """Read `{architecture: NAME, ...settings}`; SkyfixError names what is wrong."""
        if isinstance(content, NetworkChoice):
            return content
        if not isinstance(content, Mapping):
            raise SkyfixError(f"network: expected a mapping with an architecture, got {content!r}")
        settings = dict(content)
        name = str(settings.pop("architecture", "rotmatch"))
        return cls(name, settings_from(architecture_named(name), settings))

    def as_mapping(self) -> dict[str, Any]:
        """The inverse of `parse`."""
        return settings_mapping(self.architecture, self.settings)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(
            cls.parse, serialization=core_schema.plain_serializer_function_ser_schema(cls.as_mapping)
        )


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """How to train.

    Attributes
    ----------
    steps, batch
        Optimizer steps, samples a step (of all processes together).
    learning_rate, weight_decay, warmup_steps, clip_norm
        AdamW with a linear warm-up and a cosine to zero; gradients clipped to a norm.
    validate_every
        Steps between validations and checkpoints.
    workers
        Processes that make samples beside each training process (0: in it). Changes no result.
    precision
        bfloat16: autocast, where the device has it; float32: none.
    device
        cpu, or cuda for the GPU of each process.
    ema_decay
        Decay of a moving average of the weights, which is then what is validated and kept; None: no average.
    """

    steps: int = 5000
    batch: int = 8
    learning_rate: float = 2e-3
    weight_decay: float = 1e-2
    warmup_steps: int = 100
    clip_norm: float = 1.0
    validate_every: int = 250
    seed: int = 0
    workers: int = 1
    precision: Literal["bfloat16", "float32"] = "bfloat16"
    device: Literal["cpu", "cuda"] = "cpu"
    ema_decay: float | None = None
    network: NetworkChoice = field(default_factory=NetworkChoice)
    augmentation: Augmentation = field(default_factory=Augmentation)

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "validate_every", "warmup_steps", "learning_rate", "clip_norm"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise SkyfixError(f"training {name}: expected a number above zero, got {value}")
        for name in ("weight_decay", "seed", "workers"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise SkyfixError(f"training {name}: expected zero or more, got {value}")
        if self.ema_decay is not None and not 0.0 < self.ema_decay < 1.0:
            raise SkyfixError(f"training ema_decay: expected between 0 and 1, got {self.ema_decay}")
        half_heading_deg = self.augmentation.half_heading_deg
        if self.network.architecture.needs_heading and not 0.0 < half_heading_deg <= 180.0:
            raise SkyfixError(
                f"training augmentation.half_heading_deg: expected above 0 and at most 180, got {half_heading_deg}"
            )

    @property
    def known_half_heading_deg(self) -> float:
        """Within what the network is told the heading: 180 where it does without, else as it is trained, degrees."""
        return self.augmentation.half_heading_deg if self.network.architecture.needs_heading else 180.0

    def rate(self, step: int) -> float:
        """Linear warm-up, then a cosine to zero, as a factor of the learning rate."""
        warm = min(1.0, (step + 1) / self.warmup_steps)
        return warm * 0.5 * (1 + math.cos(math.pi * min(step / self.steps, 1.0)))

    def step_seed(self, step: int) -> int:
        """Seed of everything random inside a step."""
        return self.seed * 1_000_003 + step

    def torch_device(self, rank: int = 0) -> torch.device:
        """The device of a process.

        Raises
        ------
        SkyfixError
            If it is cuda and torch finds none.
        """
        if self.device == "cpu":
            return torch.device("cpu")
        if not torch.cuda.is_available():
            raise SkyfixError("training device: expected a GPU that torch can use, found none; set device to cpu")
        return torch.device("cuda", rank % torch.cuda.device_count())

    def uses_bfloat16(self, device: torch.device) -> bool:
        """Whether the losses run under autocast: asked for, and the device has the type."""
        return self.precision == "bfloat16" and (device.type != "cuda" or torch.cuda.is_bf16_supported())
