"""Does a drive fit together? What can be said of scans, map, odometry and truth before anything is tracked.

The mistakes that cost a run are few: times of two clocks, axes of another convention, a map of another place, metres
that are none, a sensor's height that is wrong. Each shows in the data alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fusion import se2
from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.odometry_limits import MotionKind
from fusion.trajectory import Trajectory
from learned.matcher import MapMatcher
from sequences.check_matching import FEWEST_RIGHT, RIGHT_M, explanation, shots_of
from sequences.drive import load_drive
from sequences.ground_height import estimate_ground_z
from sequences.metrics import from_true_start, position_errors, scored
from sequences.sequence import Sequence, odometry_is_emulated, origin_of
from sequences.shot_protocol import ShotProtocol

SCANS_LOOKED_AT = 8
_NEAR_SIGHTED_M = 15.0
_GROUND_TOLERANCE_M = 0.3
_COURSE_STEP_M, _COURSE_LEAST, _COURSE_OFF_RAD, _COURSE_SPREAD = 2.0, 5, np.deg2rad(15.0), 0.8
_SCALE_OFF, _SHORT_M = 0.1, 10.0
_MANY_JUMPS = 0.05  # of an odometry's samples
_LEAST_TURN_RAD = 0.5


class Level(StrEnum):
    """How a finding is to be taken."""

    OK = "ok"
    NOTE = "note"
    PROBLEM = "problem"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at.

    Attributes
    ----------
    level
        Problems will spoil a run; notes may.
    subject
        What of the drive.
    text
        What was found, and what was expected where it was not.
    """

    level: Level
    subject: str
    text: str


def check(sequence: Sequence, matcher: MapMatcher | None = None) -> list[Finding]:
    """Look at everything that a drive consists of.

    Parameters
    ----------
    sequence
        The drive.
    matcher
        Matches a few scans with the map about their true poses; None leaves that out, as does a drive without truth.

    Raises
    ------
    SkyfixError
        Only if the drive's files cannot be read at all.
    """
    scans, unusable = looked_at(sequence)
    findings = [*_scans(sequence, scans, unusable), *_ground(sequence, list(scans.values())), _map(sequence)]
    truth = sequence.ground_truth
    if truth is None:
        findings.append(
            Finding(Level.NOTE, "ground truth", "none: errors will not be known; give --start or --start-anywhere")
        )
    else:
        findings += _truth(sequence, truth)
    for name in sequence.odometry_names:
        findings += _told(f"odometry {name}", partial(_odometry, sequence, name))
    if not sequence.odometry_names:
        findings.append(Finding(Level.PROBLEM, "odometry", "expected at least one, found none"))
    if matcher is not None and truth is not None and scans:
        is_truth_fit = all(one.level is not Level.PROBLEM for one in findings if one.subject == "ground truth")
        findings += _told("matching", partial(_matching, sequence, matcher, is_truth_fit))
    return findings


def looked_at(sequence: Sequence) -> tuple[dict[int, NDArray[np.float32]], dict[int, str]]:
    """A few scans by their index, spread over the drive, and why others of them could not be used."""
    last = len(sequence.stamps_ns) - 1
    scans, unusable = {}, {}
    for index in np.unique(np.linspace(0, last, min(SCANS_LOOKED_AT, last + 1)).round().astype(int)).tolist():
        try:
            scans[index] = sequence.scan(index)
        except SkyfixError as error:
            unusable[index] = str(error)
    return scans, unusable


def _told(subject: str, look: Callable[[], list[Finding]]) -> list[Finding]:
    try:
        return look()
    except SkyfixError as error:
        return [Finding(Level.PROBLEM, subject, str(error))]


def _scans(sequence: Sequence, scans: Mapping[int, NDArray[np.float32]], unusable: Mapping[int, str]) -> list[Finding]:
    stamps = sequence.stamps_ns
    steps = 1e-9 * np.diff(stamps) if len(stamps) > 1 else np.zeros(1)
    kind = "simulated from the map" if sequence.scans_simulated else "measured"
    every = f"one every {np.median(steps):.2g} s (at most {steps.max():.2g})"
    text = f"{len(stamps)} ({kind}) over {steps.sum():.1f} s, {every}"
    findings = [Finding(Level.OK, "scans", text)]
    if scans:
        points = int(np.median([len(points) for points in scans.values()]))
        far_m = float(np.median([np.quantile(np.hypot(*points[:, :2].T), 0.95) for points in scans.values()]))
        level = Level.OK if far_m > _NEAR_SIGHTED_M else Level.NOTE
        what = f"some {points:,} points a scan, 95 % of them within {far_m:.0f} m"
        why = "" if level is Level.OK else f": {_NEAR_SIGHTED_M:g} m and more are usual of a LiDAR on a car"
        findings.append(Finding(level, "scans", what + why))
    if unusable:
        level = Level.NOTE if scans else Level.PROBLEM
        first = next(iter(unusable.values()))
        findings.append(Finding(level, "scans", f"{len(unusable)} of {len(scans) + len(unusable)} not usable: {first}"))
    return findings


def _ground(sequence: Sequence, scans: list[NDArray[np.float32]]) -> list[Finding]:
    if not scans:
        return []
    try:
        seen = estimate_ground_z(scans)
    except SkyfixError:
        return [Finding(Level.NOTE, "ground", f"said to be at z = {sequence.ground_z:.2f} m; the scans do not show it")]
    text = f"said to be at z = {sequence.ground_z:.2f} m, in the scans at {seen:.2f} m"
    fits = abs(seen - sequence.ground_z) <= _GROUND_TOLERANCE_M
    return [Finding(Level.OK if fits else Level.PROBLEM, "ground", text)]


def _map(sequence: Sequence) -> Finding:
    grid = sequence.map.grid
    text = f"{grid.width_m:.0f} m x {grid.height_m:.0f} m, {grid.metres_per_pixel:g} m a pixel"
    where = origin_of(sequence)
    text += "" if where is None else f", its origin at {where[0]:.6f}, {where[1]:.6f}"
    if sequence.map.classes is None:
        return Finding(Level.OK, "map", f"{text}, a picture without classes")
    if not sequence.map.shows_buildings:
        return Finding(Level.NOTE, "map", f"{text}, without buildings: expect errors of metres")
    void = float(np.mean(sequence.map.classes == 0))
    level = Level.OK if void < 0.9 else Level.NOTE
    return Finding(level, "map", f"{text}, {100 * (1 - void):.0f} % of it drawn")


def _truth(sequence: Sequence, truth: Trajectory) -> list[Finding]:
    inside = float(np.mean([sequence.map.grid.contains(pose[:2]) for pose in truth.poses]))
    covered = _share_covered(sequence, truth)
    text = f"{truth.length_m:.0f} m, at {100 * covered:.0f} % of the scans, {100 * inside:.0f} % of it on the map"
    level = Level.PROBLEM if inside < 0.5 or covered == 0.0 else Level.OK if min(inside, covered) == 1.0 else Level.NOTE
    return [Finding(level, "ground truth", text), *_course("ground truth", truth)]


def _odometry(sequence: Sequence, name: str) -> list[Finding]:
    subject = f"odometry {name}"
    odometry = sequence.odometry(name)
    drive = load_drive(sequence, name)
    emulated = " (emulated: made from the truth)" if odometry_is_emulated(name) else ""
    rate = f", one every {1e-9 * np.median(np.diff(odometry.stamp_ns)):.2g} s" if len(odometry) > 1 else ""
    covered = _share_covered(sequence, odometry)
    text = f"{odometry.length_m:.0f} m{emulated}{rate}, at {100 * covered:.0f} % of the scans"
    findings = [Finding(Level.OK if covered > 0.99 else Level.NOTE, subject, text)]
    if len(drive.doubts):
        mostly = drive.doubts.count(MotionKind.RESET) > _MANY_JUMPS * len(odometry)
        why = ": is it in metres, its times in seconds?" if mostly else ""
        findings.append(Finding(Level.PROBLEM if mostly else Level.NOTE, subject, f"{drive.doubts}{why}"))
    findings += _course(subject, odometry)
    known = None if drive.truth is None else scored(drive.truth, drive.odometry)
    if drive.truth is not None and known is not None:
        findings += _against_truth(subject, drive.truth, known)
    return findings


def _against_truth(subject: str, truth: Trajectory, odometry: Trajectory) -> list[Finding]:
    """Scale, sense of turning and drift of odometry (stamps of `truth`)."""
    if truth.length_m < _SHORT_M:
        text = f"{odometry.length_m:.1f} m where the truth is {truth.length_m:.1f} m long"
        fits = odometry.length_m < 2.0 * _SHORT_M
        return [Finding(Level.OK if fits else Level.PROBLEM, subject, text)]
    ratio = odometry.length_m / truth.length_m
    off_m = position_errors(truth.poses, from_true_start(truth, odometry).poses)
    drift = f"begun at the true pose {off_m.mean():.1f} m off on average, {off_m[-1]:.1f} m at the end"
    text = f"{ratio:.3f} of the true length; {drift}"
    fits = abs(ratio - 1.0) <= _SCALE_OFF
    if not fits:
        return [Finding(Level.PROBLEM, subject, f"{text}: is it in metres, its times in seconds?")]
    findings = [Finding(Level.OK, subject, text)]
    if _turn_opposed(*(np.diff(each.poses[:, 2]) for each in (odometry, truth))):
        text = "turns the other way than the truth: expected y to the left, yaw counter-clockwise"
        findings.append(Finding(Level.PROBLEM, subject, text))
    return findings


def _course(subject: str, trajectory: Trajectory) -> list[Finding]:
    """Whether headings point where the vehicle goes."""
    poses = trajectory.poses[_stops(trajectory.poses)]
    steps, yaw = np.diff(poses[:, :2], axis=0), poses[:-1, 2] + 0.5 * se2.wrap(np.diff(poses[:, 2]))
    if len(steps) < _COURSE_LEAST:
        return []
    course = np.arctan2(steps[:, 1], steps[:, 0])
    mean = np.exp(1j * (course - yaw)).mean()
    if abs(mean) < _COURSE_SPREAD or _turn_opposed(np.diff(yaw), np.diff(course)):
        text = "headings do not follow the path: expected yaw counter-clockwise from x, in radians"
        return [Finding(Level.PROBLEM, subject, text)]
    angle = float(np.angle(mean))
    if abs(angle) > _COURSE_OFF_RAD:
        text = f"moves {np.rad2deg(angle):+.0f} degrees off its heading: expected x forward, y to the left"
        return [Finding(Level.PROBLEM, subject, text)]
    return []


def _turn_opposed(turns: FloatArray, true_turns: FloatArray) -> bool:
    """Whether turns (N,) go the other way than others (N,) that are large enough to say."""
    turns, true_turns = se2.wrap(turns), se2.wrap(true_turns)
    return bool(np.abs(true_turns).sum() > _LEAST_TURN_RAD and turns @ true_turns < 0.0)


def _stops(poses: FloatArray) -> list[int]:
    """Indices of poses that are 2 m and a little more apart."""
    chosen = [0]
    for index in range(1, len(poses)):
        if np.hypot(*(poses[index, :2] - poses[chosen[-1], :2])) >= _COURSE_STEP_M:
            chosen.append(index)
    return chosen


def _matching(sequence: Sequence, matcher: MapMatcher, is_truth_fit: bool) -> list[Finding]:
    protocol = ShotProtocol(max_frames=SCANS_LOOKED_AT)
    shots = shots_of(sequence, protocol)
    found, off_m = shots.errors(matcher)
    off_deg, right = np.rad2deg(np.abs(se2.wrap(found[:, 2] - shots.truth[:, 2]))), float(np.mean(off_m < RIGHT_M))
    text = (
        f"{len(found)} scans matched by {matcher.name} from ±{protocol.half_extent_m:g} m, "
        f"±{protocol.half_heading_deg:g}°: median {np.median(off_m):.1f} m and {np.median(off_deg):.1f}° off, "
        f"{100 * right:.0f} % within {RIGHT_M:g} m"
    )
    if right >= FEWEST_RIGHT:
        return [Finding(Level.OK, "matching", text)]
    why = explanation(shots, matcher, found) if is_truth_fit else ""
    return [Finding(Level.PROBLEM, "matching", f"{text}; {why}" if why else text)]


def _share_covered(sequence: Sequence, trajectory: Trajectory) -> float:
    first, last = trajectory.span_ns
    return float(np.mean((sequence.stamps_ns >= first - 1_000_000) & (sequence.stamps_ns <= last + 1_000_000)))
