"""Odometry beside a drive: `odometry/NAME.tum` files, and what a reader can make itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from sequences.trajectory_io import read_odometry


class OdometryFiles:
    """The odometries of one drive by name.

    Parameters
    ----------
    folder
        Holds `odometry/`, or does not.
    label
        Names the drive in errors.
    made
        Odometries that the reader makes, by name; a file of the same name goes before it.
    """

    def __init__(self, folder: Path, label: str, made: Mapping[str, Callable[[], Trajectory]] | None = None) -> None:
        self._label = label
        self._readers: dict[str, Callable[[], Trajectory]] = dict(made or {})
        for file in folder.glob("odometry/*.tum"):
            self._readers[file.stem] = partial(read_odometry, file, file.stem)

    @property
    def names(self) -> tuple[str, ...]:
        """The names, sorted."""
        return tuple(sorted(self._readers))

    def read(self, name: str) -> Trajectory:
        """Read or make one; `SkyfixError` listing the names there are when it is unknown."""
        if name not in self._readers:
            raise SkyfixError(
                f"odometry {name!r}: unknown for {self._label}; there are: {', '.join(self.names) or 'none'}"
            )
        return self._readers[name]()
