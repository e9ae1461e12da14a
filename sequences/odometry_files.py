"""Odometry beside a drive: files in `odometry/`, see `odometry_formats`, and what a reader can make itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from sequences.odometry_formats import FORMATS, read_odometry


class OdometryFiles:
    """The odometries of one drive by name.

    Parameters
    ----------
    folder
        Holds `odometry/`, or does not.
    label
        Names the drive in errors.
    scan_stamps_ns
        Gives the stamps of the drive's scans, (N,).
    made
        Odometries that the reader makes, by name; a file of the same name goes before it.

    Raises
    ------
    SkyfixError
        If two files are of one name.
    """

    def __init__(
        self,
        folder: Path,
        label: str,
        scan_stamps_ns: Callable[[], NDArray[np.int64]],
        made: Mapping[str, Callable[[], Trajectory]] | None = None,
    ) -> None:
        self._label = label
        files: dict[str, Path] = {}
        for file in sorted(folder.glob("odometry/*")):
            if file.suffix in FORMATS and files.setdefault(file.stem, file) != file:
                raise SkyfixError(f"odometry: expected one file of a name, got {files[file.stem].name} and {file.name}")
        read = {name: partial(read_odometry, file, name, scan_stamps_ns) for name, file in files.items()}
        self._readers: dict[str, Callable[[], Trajectory]] = {**(made or {}), **read}

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
