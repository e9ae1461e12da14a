"""A drive with real odometry and EMULATED measurements: what a tracker makes of a network with published errors.

Odometry and ground truth are a sequence's own; in place of scans, a map and a network, likelihoods with a stated error
profile are drawn about the ground truth (`fusion.emulation.likelihood_emulator`). So the rows say how well odometry and
measurements of that quality are fused, and nothing about a network, a map, or the truth's own accuracy.

Fairness: the start is drawn from the profile's box about the truth and is all that the filter knows of it; odometry,
noise model and clock are those of any other run.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.consistency import error_correlation
from fusion.emulation.error_profile import TRANSLOCNET_KITTI, ErrorProfile
from fusion.emulation.likelihood_emulator import EmulatorSettings, LikelihoodEmulator
from fusion.error_memory import ErrorMemory, smoothing_temperature
from fusion.errors import SkyfixError
from fusion.estimate import Estimate
from fusion.factor_graph import OdometryDrift, SmootherSettings
from fusion.gaussian_mixture import GaussianMixture
from fusion.odometry import OdometryNoise, increments_at
from fusion.odometry_errors import OdometryCalibration
from fusion.particle_filter import ParticleFilter
from fusion.particle_smoother import ParticleSmootherSettings, sample_paths
from fusion.particles.cloud_history import CloudHistory
from fusion.prior import UniformPrior
from fusion.trajectory import Trajectory
from sequences.metrics import summarise
from sequences.offline import calibrate_drive, smooth_drive
from sequences.start import offset_in_box

_LABELS = {
    "prior": "prior",
    "odometry": "odometry only",
    "single_shot": "single shot (emulated)",
    "filter": "filter (of emulated measurements)",
    "smoother": "drawn paths (of emulated measurements)",
    "graph": "factor graph (of emulated measurements)",
}
"""Of the methods in tables."""
_START_STREAM, _PRIOR_STREAM, _FILTER_STREAM, _MEASURE_STREAM, _SMOOTHER_STREAM = range(5)


@dataclass(frozen=True, slots=True)
class EmulatedRunSettings:
    """What an emulated run depends on besides the drive.

    Attributes
    ----------
    profile
        The emulated network's errors.
    emulator
        How they repeat and how honest the likelihoods are.
    seed
        Of the start, the measurements, the particles and the paths.
    particles, kept_particles
        Of the filter, and at most kept of each cloud for the smoother.
    measure_every_m
        A measurement when the odometry has moved this far since the last one; 0 for every frame.
    handled_length_m
        Correlation length that the filter flattens likelihoods for: 0 takes errors for independent, None knows the
        emulator's own. One found by `estimate_error_correlation` is what a user would have: errors with tails repeat
        less than the Gaussians that they are drawn by.
    calibration
        The odometry's errors, taken out beforehand, and how much of the noise it really has.
    noise, smoother
        The odometry's noise as it is assumed, and how paths are drawn.
    """

    profile: ErrorProfile = TRANSLOCNET_KITTI
    emulator: EmulatorSettings = field(default_factory=EmulatorSettings)
    seed: int = 0
    particles: int = 2000
    kept_particles: int = 2000
    measure_every_m: float = 4.0
    handled_length_m: float | None = None
    calibration: OdometryCalibration = field(default_factory=OdometryCalibration)
    noise: OdometryNoise = field(default_factory=OdometryNoise)
    smoother: ParticleSmootherSettings = field(default_factory=lambda: ParticleSmootherSettings(paths=300))

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise SkyfixError(f"seed: expected 0 or more, got {self.seed}")
        if self.particles < 1:
            raise SkyfixError(f"particles: expected >= 1, got {self.particles}")
        if not (np.isfinite(self.measure_every_m) and self.measure_every_m >= 0.0):
            raise SkyfixError(f"measure_every_m: expected 0 or more, got {self.measure_every_m}")
        if self.handled_length_m is not None and not (
            np.isfinite(self.handled_length_m) and self.handled_length_m >= 0
        ):
            raise SkyfixError(f"handled_length_m: expected 0 or more, got {self.handled_length_m}")

    def correlation(self, moved_m: float) -> float:
        """What the filter takes for the correlation with the last error, so far after it."""
        if self.handled_length_m is not None:
            return error_correlation(moved_m, self.handled_length_m)
        if self.emulator.step_correlation is not None:
            return self.emulator.step_correlation if np.isfinite(moved_m) else 0.0
        return error_correlation(moved_m, self.emulator.correlation_length_m)


@dataclass(frozen=True, slots=True, eq=False)
class EmulatedRun:
    """Trajectories of an emulated run and their errors.

    Attributes
    ----------
    name
        Of the profile; it says 'emulated'.
    filter, smoother, graph
        Estimates at all stamps, with covariances: of the particle filter, of paths drawn backward through its clouds,
        and of the factor graph, which gets every measurement as a mixture and finds the odometry's errors by itself.
    single_shot
        The measurements' own answers.
    measured
        (K,) frames with a measurement.
    filter_calibration
        The odometry's errors as this run shows them: the `calibration` of a second one.
    metrics
        `metrics.summarise` by method: prior, odometry, single_shot, filter, smoother, graph.
    """

    name: str
    filter: Trajectory
    smoother: Trajectory
    graph: Trajectory
    single_shot: Trajectory
    measured: IntArray
    filter_calibration: OdometryCalibration
    metrics: dict[str, dict[str, Any]]

    def table(self) -> str:
        """The methods as a Markdown table, one line each, under a title that says what was emulated."""
        lines = [
            f"{self.name}: {len(self.measured)} emulated measurements",
            "",
            "| method | mean m | median m | max m | heading mean ° | NEES / 3 | in the 95 % ellipse |",
            "|---|--:|--:|--:|--:|--:|--:|",
        ]
        for method, errors in self.metrics.items():
            position, heading = errors["position_error_m"], errors["heading_error_deg"]
            cells = [f"{position[key]:.2f}" for key in ("mean", "median", "max")] + [f"{heading['mean']:.2f}"]
            known = "nees" in errors
            cells += [f"{errors['nees']['mean'] / 3:.2f}", f"{100 * errors['ellipse95']:.0f} %"] if known else ["", ""]
            lines.append("| " + " | ".join([_LABELS[method], *cells]) + " |")
        return "\n".join(lines) + "\n"


def run_emulated(truth: Trajectory, odometry: Trajectory, settings: EmulatedRunSettings | None = None) -> EmulatedRun:
    """Track a drive by its odometry and emulated measurements, then smooth it.

    Parameters
    ----------
    truth
        True poses in the map frame; the run has their stamps.
    odometry
        Drifting poses in a frame of its own, covering these stamps.
    settings
        Everything else.

    Raises
    ------
    SkyfixError
        If there are fewer than two poses or the odometry does not cover them.
    """
    settings = settings or EmulatedRunSettings()
    stamps, poses, profile = truth.stamp_ns, truth.poses, settings.profile
    if len(truth) < 2:
        raise SkyfixError(f"truth: expected at least two poses, got {len(truth)}")
    moved, noise = settings.calibration.corrected(odometry), settings.calibration.noise(settings.noise)
    increments = increments_at(stamps, moved, noise, tolerance_ns=1_000_000)
    box = (profile.half_extent_m, profile.half_heading_rad)
    start = poses[0] + offset_in_box(*box, np.random.default_rng([settings.seed, _START_STREAM]), 1)[0]
    streams = {n: np.random.default_rng([settings.seed, n]) for n in (_FILTER_STREAM, _MEASURE_STREAM)}
    prior = UniformPrior(start, *box)
    particles = ParticleFilter.from_prior(prior, settings.particles, streams[_FILTER_STREAM])
    emulator = LikelihoodEmulator(profile, streams[_MEASURE_STREAM], settings.emulator)
    history = CloudHistory(settings.kept_particles, settings.seed)
    estimates: list[Estimate] = []
    answers: dict[int, FloatArray] = {}
    mixtures: list[GaussianMixture | None] = []
    since_m, memory = np.inf, ErrorMemory()
    for frame, stamp in enumerate(stamps.tolist()):
        if frame:
            increment = increments[frame - 1]
            particles.predict(increment)
            history.move(increment)
            since_m += float(np.hypot(*increment.delta[:2]))
        if since_m >= settings.measure_every_m:
            likelihood = emulator.measure(poses[frame], since_m)
            correlation = settings.correlation(since_m)
            before = particles.estimate(stamp).covariance
            temperature = memory.temperature(correlation, before)
            report = particles.update(likelihood, temperature)
            memory = memory.after(correlation, temperature, before, particles.estimate(stamp).covariance)
            history.record(particles, stamp, report)
            flattening = smoothing_temperature(correlation, temperature)
            mixtures.append(likelihood.modes(len(likelihood.weights)).tempered(flattening))
            answers[frame], since_m = likelihood.answer, 0.0
        else:
            mixtures.append(None)
            if frame == len(stamps) - 1:
                history.record(particles, stamp)
        estimates.append(particles.estimate(stamp))
    smoothed = sample_paths(history, np.random.default_rng([settings.seed, _SMOOTHER_STREAM]), settings.smoother)
    measured = np.array(list(answers), dtype=np.int64)
    filtered = Trajectory(
        stamps, np.array([one.pose for one in estimates]), np.array([one.covariance for one in estimates])
    )
    single_shot = Trajectory(stamps[measured], np.array(list(answers.values())))
    offsets = offset_in_box(*box, np.random.default_rng([settings.seed, _PRIOR_STREAM]), len(truth))
    placed = _placed(np.array([increment.delta for increment in increments]), start)
    smoother = smoothed.trajectory()
    seen = (stamps, moved, noise, mixtures, prior, filtered)
    graph = smooth_drive(*seen)[0].trajectory
    calibration = calibrate_drive(*seen, SmootherSettings(drift=OdometryDrift.steady()))
    metrics = {
        "prior": summarise(poses, poses + offsets),
        "odometry": summarise(poses, placed),
        "single_shot": summarise(poses[measured], single_shot.poses),
        "filter": summarise(poses, filtered.poses, filtered.covariances),
        "smoother": summarise(poses, smoother.poses, smoother.covariances),
        "graph": summarise(poses, graph.poses, graph.covariances),
    }
    return EmulatedRun(profile.name, filtered, smoother, graph, single_shot, measured, calibration, metrics)


def _placed(deltas: FloatArray, start: FloatArray) -> FloatArray:
    """Poses (N + 1, 3) of odometry alone, from a start (3,) and N motions (N, 3)."""
    poses = np.empty((len(deltas) + 1, 3))
    poses[0] = start
    for step, delta in enumerate(deltas):
        poses[step + 1] = se2.compose(poses[step], delta)
    return poses
