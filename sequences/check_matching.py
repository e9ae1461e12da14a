"""Do scans fit the map where the truth says? Where they do not: which of the usual mistakes would explain it.

Scans whose axes are named otherwise, a map stored upside down, a truth of another clock and a map that is displaced all
look the same in a table of errors: large. So the scans are matched again as each convention would have them, and the
errors are looked at for what they have in common.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fusion.arrays import Float32Array, FloatArray
from fusion.errors import SkyfixError
from learned.answers import match_scan
from learned.map_raster import MapRaster
from learned.matcher import MapMatcher, SearchRegion
from sequences.drive import STAMP_TOLERANCE_NS
from sequences.evaluate import frames_with_truth
from sequences.measurement import best_pose
from sequences.metrics import position_errors, vehicle_frame_errors
from sequences.sequence import ScanError, Sequence
from sequences.shot_protocol import ShotProtocol

RIGHT_M = 3.0
"""Matches nearer to the truth than this are right."""
FEWEST_RIGHT = 0.5
"""Share of right matches below which something is wrong."""
_EXPLAINS = 0.3  # so many more of the matches are right
_ALIKE_M = 2.0
_LEAST_M = 1.5
_AXES: dict[str, list[list[int]]] = {
    "x to the right, y forward, z up": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
    "x backward, y to the right, z up": [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "x to the left, y backward, z up": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "x forward, y to the right, z up": [[1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "x forward, y to the right, z down": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "x to the right, y down, z forward": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
}
"""Other conventions for a scan's axes, and what turns their points into x forward, y to the left, z up."""


@dataclass(frozen=True, slots=True, eq=False)
class Shots:
    """Scans with the poses (N, 3) at which they are said to be taken, where each is looked for, and the speeds (N,)."""

    scans: tuple[Float32Array, ...]
    truth: FloatArray
    searches: tuple[SearchRegion, ...]
    speeds: FloatArray
    ground_z: float
    map_raster: MapRaster

    def errors(self, matcher: MapMatcher) -> tuple[FloatArray, FloatArray]:
        """Poses (N, 3) that a matcher finds, and how far each is off (N,), metres."""
        asked = zip(self.scans, self.searches, strict=True)
        found = [best_pose(match_scan(matcher, scan, self.ground_z, self.map_raster, one)) for scan, one in asked]
        return np.array(found), position_errors(self.truth, np.array(found))

    def share_right(self, matcher: MapMatcher) -> float:
        """Share of the matches that are right; 0 where the matcher cannot use the scans."""
        try:
            return float(np.mean(self.errors(matcher)[1] < RIGHT_M))
        except SkyfixError:
            return 0.0


def shots_of(sequence: Sequence, protocol: ShotProtocol) -> Shots:
    """The scans that a check matches.

    Raises
    ------
    SkyfixError
        If there is none with a true pose.
    """
    truth = sequence.ground_truth
    if truth is None:
        raise SkyfixError(f"{sequence.name}: expected ground truth to compare with, found none")
    chosen = frames_with_truth(sequence, truth, protocol.max_frames)
    stamps = sequence.stamps_ns[chosen]
    poses = truth.interpolate(stamps, STAMP_TOLERANCE_NS)
    around = np.clip(np.stack([stamps - 10**9 // 2, stamps + 10**9 // 2]), *truth.span_ns)
    way = np.linalg.norm(np.diff(truth.interpolate(around.ravel()).reshape(2, -1, 3)[..., :2], axis=0)[0], axis=1)
    speeds = way / np.maximum(1e-9 * np.diff(around, axis=0)[0], 1e-3)
    scans: dict[int, Float32Array] = {}
    for number, index in enumerate(chosen.tolist()):
        try:
            scans[number] = sequence.scan(index)
        except ScanError:
            continue
    if not scans:
        raise SkyfixError(f"{sequence.name}: expected a usable scan, got none in {len(chosen)}")
    used, searches = list(scans), protocol.searches(poses)
    sought = tuple(searches[number] for number in used)
    return Shots(tuple(scans.values()), poses[used], sought, speeds[used], sequence.ground_z, sequence.map)


def explanation(shots: Shots, matcher: MapMatcher, found: FloatArray) -> str:
    """What would make most of the matches (N, 3) right, if anything of what is tried does; else nothing."""
    right = float(np.mean(position_errors(shots.truth, found) < RIGHT_M))
    variants = {
        f"if the scans' axes are {axes}": replace(shots, scans=tuple(_turned(scan, turn) for scan in shots.scans))
        for axes, turn in _AXES.items()
    }
    flipped = shots.map_raster
    classes = None if flipped.classes is None else np.ascontiguousarray(flipped.classes[::-1])
    flipped = replace(flipped, classes=classes, picture=np.ascontiguousarray(flipped.picture[::-1]))
    variants["if row 0 of the map is south"] = replace(shots, map_raster=flipped)
    shares = {name: variant.share_right(matcher) for name, variant in variants.items()}
    best = max(shares, key=lambda name: shares[name])
    if shares[best] >= max(FEWEST_RIGHT, right + _EXPLAINS):
        return f"{100 * shares[best]:.0f} % {best}"
    return _in_common(shots, found)


def _turned(scan: Float32Array, turn: list[list[int]]) -> Float32Array:
    turned = scan.copy()
    turned[:, :3] = scan[:, :3] @ np.array(turn, dtype=np.float32).T
    return turned


def _in_common(shots: Shots, found: FloatArray) -> str:
    """What most matches are off by alike: along the vehicle, which is a time, or on the map."""
    on_map = found[:, :2] - shots.truth[:, :2]
    ahead, left, _ = vehicle_frame_errors(shots.truth, found)
    moving = shots.speeds > 1.0
    if moving.any():
        late_s = float(np.median(ahead[moving] / shots.speeds[moving]))
        in_time = np.hypot(ahead - late_s * shots.speeds, left)
        if np.mean(in_time < _ALIKE_M) >= FEWEST_RIGHT and abs(late_s) * np.median(shots.speeds) > _LEAST_M:
            return f"most are {abs(late_s):.2f} s {'ahead of' if late_s > 0 else 'behind'} the truth: one clock?"
    east, north = np.median(on_map, axis=0)
    alike = np.hypot(*(on_map - (east, north)).T) < _ALIKE_M
    if np.mean(alike) >= FEWEST_RIGHT and np.hypot(east, north) > _LEAST_M:
        return f"most are x {east:+.1f} m, y {north:+.1f} m from the truth: is the map where it says?"
    return ""
