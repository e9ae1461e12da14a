"""Drives that go wrong on purpose, cut from a good one: a kidnapping, a start anywhere, a stretch unmatched."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from learned.map_raster import MapRaster
from sequences.drive import Drive
from sequences.sequence import ScanError, Sequence

_DRAWS = 2000


class SplicedSequence:
    """Frames of a drive in another order, as one `sequences.sequence.Sequence`.

    The odometry runs on from piece to piece as if the vehicle had stood still in between: it reports nothing of a jump.
    Stamps go on at the drive's own pace. Scans, map and truth are the drive's.

    Parameters
    ----------
    drive
        Where frames come from; it has a truth.
    pieces
        Frame numbers of the drive, one array a piece.
    blind
        Frames (of the spliced sequence) whose scans cannot be used.
    """

    name = "spliced"
    odometry_names: tuple[str, ...] = ("spliced",)

    def __init__(self, drive: Drive, pieces: list[IntArray], blind: range = range(0)) -> None:
        if drive.truth is None:
            raise SkyfixError(f"{drive.sequence.name}: recovery is measured against ground truth, got none")
        self._drive, self._frames, self._blind = drive, np.concatenate(pieces), blind
        steps = np.concatenate([np.diff(drive.stamps_ns[piece], prepend=np.int64(-1)) for piece in pieces])
        steps[np.cumsum([0, *(len(piece) for piece in pieces[:-1])])] = round(
            float(np.median(np.diff(drive.stamps_ns)))
        )
        self.stamps_ns: NDArray[np.int64] = np.cumsum(steps)
        self.ground_truth: Trajectory | None = Trajectory(self.stamps_ns, drive.truth.poses[self._frames], None, "map")
        end, poses = np.zeros(3), []
        for piece in pieces:
            moved = se2.between(drive.odometry.poses[piece[:1]], drive.odometry.poses[piece])
            poses.append(se2.compose(end[None], moved))
            end = poses[-1][-1]
        self._odometry = Trajectory(self.stamps_ns, np.concatenate(poses), None, "odometry")

    @property
    def map(self) -> MapRaster:
        """The drive's."""
        return self._drive.sequence.map

    @property
    def ground_z(self) -> float:
        """The drive's."""
        return self._drive.sequence.ground_z

    @property
    def scans_simulated(self) -> bool:
        """The drive's."""
        return self._drive.sequence.scans_simulated

    def scan(self, index: int) -> NDArray[np.float32]:
        """The drive's scan at that frame; `ScanError` at a blind one."""
        if index in self._blind:
            raise ScanError(f"scan {index}: withheld")
        return self._drive.sequence.scan(int(self._drive.indices[self._frames[index]]))

    def odometry(self, name: str) -> Trajectory:
        """The drive's odometry, spliced; there is no other name than 'spliced'."""
        if name not in self.odometry_names:
            raise SkyfixError(f"odometry: expected one of {', '.join(self.odometry_names)}, got {name}")
        return self._odometry


@dataclass(frozen=True, slots=True, eq=False)
class Incident:
    """A drive and where it goes wrong.

    Attributes
    ----------
    sequence
        The drive.
    way_m
        (M,) metres driven up to each frame, a jump not counted.
    first, last
        First frame after the incident began, and first frame after it ended (the same for a kidnapping).
    """

    sequence: Sequence
    way_m: FloatArray
    first: int
    last: int


class IncidentMaker:
    """Cuts incidents from a drive.

    Parameters
    ----------
    drive
        With ground truth.
    """

    def __init__(self, drive: Drive) -> None:
        if drive.truth is None:
            raise SkyfixError(f"{drive.sequence.name}: recovery is measured against ground truth, got none")
        self._drive = drive
        self._xy = drive.truth.poses[:, :2]
        steps = np.hypot(*np.diff(self._xy, axis=0).T)
        self._way_m = np.concatenate([[0.0], np.cumsum(steps)])
        self._inside = drive.sequence.map.grid.contains(self._xy)

    def kidnapping(self, rng: np.random.Generator, jump_m: float, after_m: float) -> Incident:
        """60 to 100 m of the drive, then `after_m` from about `jump_m` away, by up to a tenth."""
        for _ in range(_DRAWS):
            start, target = rng.integers(0, len(self._xy), 2)
            before = self._piece(int(start), float(rng.uniform(60.0, 100.0)))
            after = self._piece(int(target), after_m)
            if before is None or after is None:
                continue
            jumped = float(np.hypot(*(self._xy[after[0]] - self._xy[before[-1]])))
            if abs(jumped - jump_m) <= 0.1 * jump_m:
                return self._incident([before, after], len(before), len(before))
        raise SkyfixError(f"{self._drive.sequence.name}: expected places {jump_m:g} m apart, found none")

    def anywhere(self, rng: np.random.Generator, length_m: float) -> Incident:
        """A stretch of the drive."""
        return self._incident([self._random_piece(rng, length_m)], 0, 0)

    def outage(self, rng: np.random.Generator, before_m: float, blind_m: float, after_m: float) -> Incident:
        """A stretch of the drive whose middle has no usable scans."""
        piece = self._random_piece(rng, before_m + blind_m + after_m)
        way = self._way_m[piece] - self._way_m[piece[0]]
        first, last = (int(np.searchsorted(way, at)) for at in (before_m, before_m + blind_m))
        return self._incident([piece], first, last, range(first, last))

    def _random_piece(self, rng: np.random.Generator, length_m: float) -> IntArray:
        for _ in range(_DRAWS):
            piece = self._piece(int(rng.integers(0, len(self._xy))), length_m)
            if piece is not None:
                return piece
        raise SkyfixError(f"{self._drive.sequence.name}: expected {length_m:g} m in one piece, found none")

    def _piece(self, start: int, length_m: float) -> IntArray | None:
        """Frames from `start` on for a length, or None when the drive ends or leaves the map before."""
        end = int(np.searchsorted(self._way_m, self._way_m[start] + length_m))
        if end >= len(self._xy) or not self._inside[start : end + 1].all():
            return None
        return np.arange(start, end + 1)

    def _incident(self, pieces: list[IntArray], first: int, last: int, blind: range = range(0)) -> Incident:
        steps = [np.diff(self._way_m[piece], prepend=self._way_m[piece[0]]) for piece in pieces]
        return Incident(SplicedSequence(self._drive, pieces, blind), np.cumsum(np.concatenate(steps)), first, last)
