"""An odometry's errors, found from the drive itself: its clock, its headings' lead, its drift, and how noisy it is.

An odometry comes from another pipeline than the scans. Its stamps are a tenth of a second off; headings taken from the
tangent of a path run ahead of the vehicle, those taken from a chord of it cut its corners; a camera looks a little to
one side; a stereo baseline is one per cent short, or a scale wanders. None of these is noise: they do not average out,
and each is a drift, or half a degree in every turn. And how much noise is left differs tenfold from one pipeline to
another.

With the right values odometry and map agree best. So they are those under which the measurements are most probable
(their evidence, everything else integrated out), with a prior that keeps them usual where the drive tells nothing.
Scale, mounting and heading bias are states of the graph. What is left, clocks and sizes of noise, is searched for with
the measurements' factors held, so that a trial is a linear problem; then the factors are found anew, once.

Sources: Furgale, Rehder, Siegwart, "Unified temporal and spatial calibration for multi-sensor systems", IROS 2013;
MacKay, "Bayesian interpolation", 1992 (evidence).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.graph.assembly import pose_graph
from fusion.graph.chain import Chain
from fusion.graph.covariances import positive_definite, raised
from fusion.graph.measurements import Measurement, Measurements
from fusion.graph.odometry_drift import OdometryDrift
from fusion.graph.propagation import Propagated, propagate
from fusion.graph.smoother_settings import SmootherSettings
from fusion.odometry import OdometryNoise
from fusion.odometry_doubts import OdometryDoubts
from fusion.odometry_errors import OdometryCalibration
from fusion.prior import UniformPrior
from fusion.trajectory import Trajectory, rising_stamps

_LARGEST_S = 0.45
_ROUNDS = 3
_CAUTION = 1.0  # ln of the factor by which the odometry is trusted less before its errors are known
_LEAST_LOG_FACTORS = np.log([0.2, 0.2, 0.25, 0.1])  # jitter that comes and goes between measurements leaves no evidence
_LEAST_VARIANCE = 1e-8  # 0.1 mm, 0.1 mrad: an odometry said to be surer is not solved for in a trial's few steps
_TRIAL_STEPS = 2
_MOST_STEPS = 4


@dataclass(frozen=True, slots=True)
class CalibrationPrior:
    """Standard deviations of what an odometry is like before the drive is seen.

    Parameters
    ----------
    clock_offset_s, heading_lead_s, heading_lead_m, heading_blur_s : float
        About zero.
    log_noise : float
        Of ln of the factors of noise and walk, about zero.

    Raises
    ------
    SkyfixError
        When a value is not positive and finite.
    """

    clock_offset_s: float = 0.1
    heading_lead_s: float = 0.1
    heading_lead_m: float = 0.7
    heading_blur_s: float = 0.2
    log_noise: float = 0.7

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not (np.isfinite(value) and value > 0.0):
                raise SkyfixError(f"calibration prior {entry.name}: expected > 0, got {value}")

    @property
    def sigmas(self) -> FloatArray:
        """(8,), of what is searched for."""
        errors = [self.clock_offset_s, self.heading_lead_s, self.heading_lead_m, self.heading_blur_s]
        return np.array([*errors, *[self.log_noise] * 4])


_DIRECTIONS = np.array(
    [
        [0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],  # the clock of positions and headings
        [0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0],  # the place of the headings,
        [0.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],  # their clock,
        [0.0, 0.1, -0.7, 0.0, 0.0, 0.0, 0.0, 0.0],  # one for the other
        [0.1, -0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],  # the clock of the positions alone
        [0.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.0],  # the headings' blur
        [0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0],  # ln of the factors: noise along,
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0],  # across,
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0],  # of the heading,
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.7],  # and the scale's walk
    ]
)
"""Steps of the search."""


def calibrate_odometry(
    stamps_ns: ArrayLike,
    odometry: Trajectory,
    noise: OdometryNoise,
    measurements: Sequence[Measurement],
    prior: UniformPrior,
    initial: Trajectory,
    settings: SmootherSettings | None = None,
    calibration_prior: CalibrationPrior | None = None,
    doubts: OdometryDoubts | None = None,
) -> OdometryCalibration:
    """The most probable errors of an odometry, given what was measured along the drive.

    Parameters
    ----------
    stamps_ns : (N,) int64
        Times of the measurements, strictly increasing.
    odometry : Trajectory
        In a frame of its own; it covers the stamps but for less than half a second.
    noise : OdometryNoise
        What is assumed of its random errors.
    measurements : sequence of N Measurement
        Tempered for errors that are correlated in time.
    prior, initial
        As for `fusion.factor_graph.smooth`.
    settings : SmootherSettings
        As there; its drift is what is assumed of how scale, mounting and heading bias change, the default when None.
        For a filter, which cannot follow such changes, find the noise with `OdometryDrift.steady`.
    calibration_prior : CalibrationPrior
        What errors are usual.
    doubts : OdometryDoubts
        Where the odometry is known less well than its noise says.

    Raises
    ------
    SkyfixError
        As `smooth` does, and when no trial has a finite evidence.
    """
    stamps = rising_stamps(stamps_ns)
    if len(measurements) != len(stamps):
        raise SkyfixError(f"odometry calibration: expected {len(stamps)} measurements, got {len(measurements)}")
    settings = settings or SmootherSettings()
    if len(stamps) < 2:
        return OdometryCalibration()
    drift = settings.drift or OdometryDrift()
    search = _Search(stamps, odometry, doubts or OdometryDoubts.none(), noise, prior, settings, drift)
    seen = Measurements(measurements, settings.outlier_probability, settings.clutter_log_density)
    sigmas = (calibration_prior or CalibrationPrior()).sigmas
    poses = initial.interpolate(stamps)
    covariances = np.repeat(np.eye(3)[None], len(stamps), axis=0)
    if initial.covariances is not None:
        at = np.searchsorted(initial.stamp_ns, stamps, side="right") - 1
        covariances = positive_definite(initial.covariances[at])
    values = np.zeros(len(sigmas))
    careful = np.array([*[0.0] * 4, *[_CAUTION] * 4])
    found = search.propagated(careful, seen, poses, covariances)
    for _ in range(_ROUNDS):
        held = found

        def cost(tried: FloatArray, held: Propagated = held) -> float:
            with np.errstate(over="ignore"):  # far from a prior that is very sure
                unusual = 0.5 * float(((tried / sigmas) ** 2).sum())
            return unusual - search.log_evidence(tried, held, seen.nodes)

        for step in _DIRECTIONS:
            values = _best_along(step, values, cost)
        assert found.solution.covariances is not None  # every round asks for them
        found = search.propagated(values, seen, found.solution.poses, found.solution.covariances)
    log_scale, mount, bias = found.solution.calibrations.mean(axis=0).tolist()
    calibration = _calibration(values)
    return replace(calibration, log_scale=log_scale, mount_yaw_rad=mount, heading_bias_rad_per_m=bias)


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """The drive as a function of what is searched for."""

    stamps: IntArray
    odometry: Trajectory
    doubts: OdometryDoubts
    noise: OdometryNoise
    prior: UniformPrior
    settings: SmootherSettings
    drift: OdometryDrift

    def chain(self, calibration: OdometryCalibration) -> Chain:
        """Motions between the measurements."""
        poses = calibration.corrected(self.odometry).interpolate(self.stamps)
        deltas = se2.between(poses[:-1], poses[1:])
        noise = calibration.noise(self.noise)
        covariances = noise.covariances(deltas, np.diff(self.stamps) * 1e-9)
        covariances += self.doubts.later(calibration.clock_offset_s).between(self.stamps)
        return Chain(deltas, raised(covariances, _LEAST_VARIANCE))

    def propagated(
        self, values: FloatArray, seen: Measurements, poses: FloatArray, covariances: FloatArray
    ) -> Propagated:
        """The smoothed drive."""
        calibration = _calibration(values)
        settings = replace(self.settings, drift=calibration.drift(self.drift))
        graph = pose_graph(self.chain(calibration), self.prior, settings)
        return propagate(graph, seen, poses, covariances, settings.max_iterations)

    def log_evidence(self, values: FloatArray, held: Propagated, nodes: IntArray) -> float:
        """ln density of the measurements, their factors as in `held`, up to a constant."""
        calibration = _calibration(values)
        drift, chain = calibration.drift(self.drift), self.chain(calibration)
        graph = pose_graph(chain, self.prior, replace(self.settings, drift=drift))
        solution = graph.at(held.solution.poses, nodes, held.sites)
        for _ in range(_TRIAL_STEPS):
            solution = graph.step(solution, nodes, held.sites, marginals=False)
        log_scales = 0.5 * np.linalg.slogdet(chain.covariances)[1].sum()
        log_scales += (len(solution.calibrations) - 1) * np.log(drift.step_sigmas).sum()
        return -solution.cost - solution.half_log_det - float(log_scales)


def _calibration(values: FloatArray) -> OdometryCalibration:
    """That of values (8,) of the search; within what can be believed of an odometry."""
    clock, lead = np.clip(values[:2], -_LARGEST_S, _LARGEST_S).tolist()
    along, across, heading, walk = np.exp(np.maximum(values[4:], _LEAST_LOG_FACTORS)).tolist()
    return OdometryCalibration(
        clock,
        lead,
        heading_lead_m=float(values[2]),
        heading_blur_s=float(np.clip(values[3], 0.0, _LARGEST_S)),
        along_noise=along,
        across_noise=across,
        heading_noise=heading,
        scale_walk=walk,
    )


def _best_along(step: FloatArray, origin: FloatArray, cost: Callable[[FloatArray], float]) -> FloatArray:
    """The minimum along a direction: downhill by steps, then the vertex of a parabola through three costs."""

    def at(steps: float) -> float:
        found = cost(origin + steps * step)
        return found if np.isfinite(found) else np.inf

    costs = {k: at(k) for k in (0, -1, 1)}  # of equals the first: not to move
    best = min(costs, key=costs.__getitem__)
    if costs[best] == np.inf:
        raise SkyfixError("odometry calibration: expected a finite evidence of the measurements, got none in any trial")
    while 0 < abs(best) < _MOST_STEPS and (further := best + int(np.sign(best))) not in costs:
        costs[further] = at(further)
        best = min(costs, key=costs.__getitem__)
    below, here, above = (costs.get(best + k, np.inf) for k in (-1, 0, 1))
    bend = below - 2.0 * here + above
    if not 0.0 < bend < np.inf:
        return origin + best * step
    vertex = best + 0.5 * (below - above) / bend
    return origin + (vertex if at(vertex) < here else best) * step
