"""What an ablation varies: YAML that names a training's configuration and what each variant changes of it.

    base: hybrid.yaml                       beside this file, or a path from its folder
    evaluation_samples: 128                 held-out simulated samples that every network is scored on
    variants:
      full: {}
      "without cross-attention": {training.network.cross_attention: false}
    grid:                                   every combination is a variant too
      training.network.regression_weight: [0.5, 1.0]
      training.network.contrastive_weight: [0.05, 0.1]

Keys are dotted paths into the base, as with `skyfix train --set`.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from fusion.errors import SkyfixError
from sequences.dotted_keys import as_overrides
from sequences.train_config import TrainConfig, read_config


class _Content(BaseModel):
    """The file as it is; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    base: str
    evaluation_samples: int = Field(default=128, ge=1)
    variants: dict[str, dict[str, Any]] = {}
    grid: dict[str, list[Any]] = {}


@dataclass(frozen=True, slots=True)
class Variant:
    """One line of the table.

    Attributes
    ----------
    name
        As the table calls it.
    changes
        Dotted key -> value, in place of what the base says.
    config
        The training that comes of it, seed apart.
    point
        Its coordinates in the grid, one a key of `Ablation.grid`; None for a named variant.
    """

    name: str
    changes: Mapping[str, Any]
    config: TrainConfig
    point: tuple[Any, ...] | None = None

    @property
    def overrides(self) -> tuple[str, ...]:
        """The changes as `sequences.train_config.read_config` takes them."""
        return as_overrides(self.changes)

    @property
    def folder(self) -> str:
        """A name for its folder."""
        return re.sub(r"[^a-z0-9.]+", "-", self.name.lower()).strip("-.")


@dataclass(frozen=True, slots=True)
class Ablation:
    """A checked ablation.

    Attributes
    ----------
    path, base
        Its file and the base's.
    variants
        Named ones first, then the grid's.
    grid
        Dotted key -> values.
    evaluation_samples
        Held-out simulated samples for every network.
    """

    path: Path
    base: Path
    variants: tuple[Variant, ...]
    grid: Mapping[str, Sequence[Any]]
    evaluation_samples: int


def read_ablation(path: Path, overrides: Sequence[str] = ()) -> Ablation:
    """Read an ablation and the configuration of every variant.

    Parameters
    ----------
    path
        The file.
    overrides
        "KEY.KEY=VALUE" each, changed in the base for all variants.

    Raises
    ------
    SkyfixError
        If the file or its base is missing or is not YAML, a key is unknown, or there is nothing to compare.
    """
    content = _content(path)
    base = path.parent / content.base
    read_config(base, overrides)
    named = [(name, changes, None) for name, changes in content.variants.items()]
    points = itertools.product(*content.grid.values()) if content.grid else ()
    gridded = [
        (_point_name(content.grid, point), dict(zip(content.grid, point, strict=True)), point) for point in points
    ]
    variants = tuple(_variant(path, base, overrides, *each) for each in (*named, *gridded))
    if not variants:
        raise SkyfixError(f"ablation {path.name}: expected variants or a grid, got neither")
    taken: dict[str, str] = {}
    for variant in variants:
        if not variant.folder or variant.folder in taken:
            other = taken.get(variant.folder, "no letter or digit")
            raise SkyfixError(
                f"ablation {path.name}: expected names that make distinct folders, got {variant.name!r} and {other!r}"
            )
        taken[variant.folder] = variant.name
    return Ablation(path, base, variants, content.grid, content.evaluation_samples)


def _content(path: Path) -> _Content:
    if not path.is_file():
        raise SkyfixError(f"ablation: expected a YAML file at {path}, got no such file")
    try:
        return _Content.model_validate(yaml.safe_load(path.read_text(encoding="utf-8")))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise SkyfixError(f"ablation {path.name}: expected YAML, got {str(error).splitlines()[0]}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        message = f"{where}: {first['msg']}, got {first['input']!r}" if where else first["msg"]
        raise SkyfixError(f"ablation {path.name}: {message}") from error


def _variant(
    path: Path,
    base: Path,
    overrides: Sequence[str],
    name: str,
    changes: Mapping[str, Any],
    point: tuple[Any, ...] | None,
) -> Variant:
    try:
        if "training.seed" in changes:
            raise SkyfixError("training.seed: expected to be left to --seeds, got a value")
        return Variant(name, changes, read_config(base, (*overrides, *as_overrides(changes))), point)
    except SkyfixError as error:
        raise SkyfixError(f"ablation {path.name}: variant {name!r}: {error}") from error


def _point_name(grid: Mapping[str, Sequence[Any]], point: tuple[Any, ...]) -> str:
    return ", ".join(f"{key.rpartition('.')[2]} {value}" for key, value in zip(grid, point, strict=True))
