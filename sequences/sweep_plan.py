"""What a sweep tracks: drives x odometries x matchers x settings x seeds, all checked before the first is started."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fusion.errors import SkyfixError
from learned.own_matcher import own_matcher_named
from sequences.dotted_keys import as_overrides, changed, split_override
from sequences.registry import OpenOptions, open_sequence
from sequences.sequence import Sequence as Drive
from sequences.sequence import odometry_is_emulated
from sequences.track_settings import SETTABLE, TrackSettings


@dataclass(frozen=True, slots=True)
class SweepOptions:
    """What is varied.

    Attributes
    ----------
    odometries
        Names; of each drive those that it has. Empty: those that are not emulated, or all where all are.
    matchers
        As `learned.matcher.load_matcher` takes them.
    seeds
        Of start, particles and simulated scans; what is varied besides is tracked with each.
    overrides
        "KEY=VALUE" each, a key of `TrackSettings`. A list of values is swept, every combination with the other lists.
    """

    odometries: Sequence[str] = ()
    matchers: Sequence[str] = ("rotmatch",)
    seeds: Sequence[int] = (0,)
    overrides: Sequence[str] = ()

    def __post_init__(self) -> None:
        if not self.seeds or len(set(self.seeds)) != len(self.seeds) or min(self.seeds) < 0:
            raise SkyfixError(f"--seeds: expected distinct numbers of zero or more, got {list(self.seeds)}")
        labels = [matcher_label(matcher) for matcher in self.matchers]
        if not labels or len(set(labels)) != len(labels):
            raise SkyfixError(f"--matcher: expected matchers of distinct names, got {', '.join(labels) or 'none'}")


@dataclass(frozen=True, slots=True)
class SweepRun:
    """One drive to track.

    Attributes
    ----------
    drive, name
        As `sequences.registry.open_sequence` takes it, and what the drive calls itself.
    matcher
        As `load_matcher` takes it.
    settings
        Everything else, odometry and seed among it.
    changes
        Dotted key -> value of what is swept.
    folder
        Its run directory.
    """

    drive: Path
    name: str
    matcher: str
    settings: TrackSettings
    changes: Mapping[str, Any]
    folder: Path = field(compare=False)

    @property
    def variant(self) -> str:
        """What it is called among the runs of its drive and odometry."""
        return ", ".join([matcher_label(self.matcher), *(f"{key} {_shown(self.changes[key])}" for key in self.changes)])

    @property
    def label(self) -> str:
        """As messages call it."""
        return f"{self.name}, {self.settings.odometry}, {self.variant}, seed {self.settings.seed}"


def matcher_label(matcher: str) -> str:
    """A matcher's name: of a checkpoint its folder's and its own, for those of one network are called alike."""
    own, path = own_matcher_named(matcher), Path(matcher)
    if own is not None:
        return own.label
    return f"{path.resolve().parent.name}/{path.stem}" if path.suffix else path.name


def plan_runs(drives: Sequence[Path], options: SweepOptions, out_dir: Path) -> list[SweepRun]:
    """All runs, seeds the outer loop.

    Raises
    ------
    SkyfixError
        If a drive cannot be opened, has no ground truth or none of the odometries, a name comes twice, or a setting is
        not one or out of range.
    """
    opened = [open_sequence(path, OpenOptions(options.seeds[0])) for path in drives]
    names = [drive.name for drive in opened]
    if not names or len(set(names)) != len(names):
        raise SkyfixError(f"sweep: expected drives of distinct names, got {', '.join(names) or 'none'}")
    for drive in opened:
        if drive.ground_truth is None:
            raise SkyfixError(f"{drive.name}: expected ground truth to compare with, found none")
    tracks = [
        (path, drive.name, name)
        for path, drive in zip(drives, opened, strict=True)
        for name in _odometries(drive, options.odometries)
    ]
    combinations = _combinations(options.overrides)
    runs = []
    for seed, (path, name, odometry) in itertools.product(options.seeds, tracks):
        for matcher, changes in itertools.product(options.matchers, combinations):
            settings = changed(TrackSettings(odometry, seed), as_overrides(changes), SETTABLE)
            swept = {key: value for key, value in changes.items() if any(each[key] != value for each in combinations)}
            parts = [name, odometry, matcher_label(matcher), *(f"{key}-{_shown(swept[key])}" for key in swept)]
            folder = out_dir / "runs" / _slug("-".join(parts)) / f"seed-{seed}"
            runs.append(SweepRun(path, name, matcher, settings, swept, folder))
    if len({run.folder for run in runs}) != len(runs):
        raise SkyfixError("sweep: expected runs that differ, got some that are written alike")
    return runs


def _odometries(drive: Drive, wanted: Sequence[str]) -> list[str]:
    names = list(drive.odometry_names)
    real = [name for name in names if not odometry_is_emulated(name)]
    found = [name for name in wanted if name in names] if wanted else real or names
    if not found:
        expected = f"one of {', '.join(wanted)}" if wanted else "an odometry"
        raise SkyfixError(f"{drive.name}: expected {expected}, found {', '.join(names) or 'none'}")
    return found


def _combinations(overrides: Sequence[str]) -> list[dict[str, Any]]:
    """Dotted key -> value, of every combination of the values of the lists."""
    choices: dict[str, list[Any]] = {}
    for override in overrides:
        keys, value = split_override(override)
        values = value if isinstance(value, list) else [value]
        if not values:
            raise SkyfixError(f"--set {override}: expected a value or a list of them, got an empty one")
        choices[".".join(keys)] = values
    return [dict(zip(choices, values, strict=True)) for values in itertools.product(*choices.values())]


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _slug(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9._-]+", "_", text).strip("._")
