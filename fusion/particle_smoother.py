"""The particle smoother: whole paths given all odometry and all measurements, from the clouds a filter left behind.

Forward filtering, backward simulation: a path starts at a particle of the last cloud and goes back record by record,
each time to a particle from which the odometry could have brought it where it is. M such paths are independent draws
of the joint smoothing density of the recorded stamps, multimodal or not. Between records the odometry's own
conditional density fills in the other stamps (see `odometry_bridge`).

Where a filter was lost and drew particles anew, a pose may have come by the odometry or from anywhere. The filter's
mixture says how likely each is: with j the odds of being lost before the measurement times the density of a lost pose,
the particle before y is i with a probability in proportion to

    w_i (p(y | x_i, odometry) + j)

so with probability j / (j + sum_i w_i p(y | x_i, odometry)) a path jumps: it goes on from any particle of the cloud
before, and between the two records it drives as the odometry says until the jump. The history must have been given the
filter's reports (`CloudHistory.record`). As many nodes as measurements,
a few metres apart, are better than many more: the finer the step, the fewer particles could have led to a particle.

Sources: Godsill, Doucet, West, "Monte Carlo smoothing for nonlinear time series", JASA 2004; Douc, Garivier,
Moulines, Olsson, "Sequential Monte Carlo smoothing for general state space hidden Markov models", Annals of Applied
Probability 2011.
"""

from dataclasses import dataclass

import numpy as np

from fusion import se2
from fusion.arrays import BoolArray, FloatArray, IntArray, read_only
from fusion.errors import SkyfixError
from fusion.kernels.backward import motion_density, step_back
from fusion.odometry import OdometryIncrement, accumulate
from fusion.particles.cloud_history import CloudHistory, RecordedCloud
from fusion.particles.clusters import VARIANCE_FLOOR
from fusion.particles.odometry_bridge import bridge
from fusion.particles.regularisation import matrix_root
from fusion.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class ParticleSmootherSettings:
    """How the smoother behaves.

    Parameters
    ----------
    paths : int
        Number of paths drawn.
    max_rejections : int
        Proposals of rejection sampling a path and record; then one exact draw, which costs as many evaluations as
        there are particles. 0 draws exactly at once.
    floor_m, floor_rad : float
        Standard deviations added to the odometry's between records. Where odometry claims to be (nearly) perfect, no
        particle but its own parent could lead to a particle, and paths would only be the filter's family tree.

    Raises
    ------
    SkyfixError
        When a value is out of range.
    """

    paths: int = 500
    max_rejections: int = 50
    floor_m: float = 0.01
    floor_rad: float = 0.0005

    def __post_init__(self) -> None:
        if self.paths < 2:
            raise SkyfixError(f"paths: expected >= 2, got {self.paths}")
        if self.max_rejections < 0:
            raise SkyfixError(f"max_rejections: expected >= 0, got {self.max_rejections}")
        for name in ("floor_m", "floor_rad"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise SkyfixError(f"{name}: expected > 0, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, eq=False)
class PathSamples:
    """Equally likely paths.

    Parameters
    ----------
    stamp_ns : (T,) int64
        Stamps of the poses.
    paths : (M, T, 3) float64
        ``[x, y, yaw]``, map frame; yaw wrapped.
    accepted_share : float
        Share of the steps back that rejection sampling settled; jumps are not among them.
    jumped : (M, R - 1) bool
        Whether each path jumped just before the second and the later ones of the R records.
    """

    stamp_ns: IntArray
    paths: FloatArray
    accepted_share: float
    jumped: BoolArray

    def trajectory(self) -> Trajectory:
        """Means, circular in yaw, with covariances of the paths; a millimetre is added, so that they are positive
        definite whatever the paths."""
        x_y = self.paths[..., :2].mean(axis=0)
        yaw = np.arctan2(np.sin(self.paths[..., 2]).mean(axis=0), np.cos(self.paths[..., 2]).mean(axis=0))
        means = np.column_stack([x_y, se2.wrap(yaw)])
        off = self.paths - means
        off[..., 2] = se2.wrap(off[..., 2])
        covariances = np.einsum("mti,mtj->tij", off, off) / (len(self.paths) - 1) + VARIANCE_FLOOR
        return Trajectory(self.stamp_ns, means, covariances)


def sample_paths(
    history: CloudHistory,
    seed: int | np.random.Generator,
    settings: ParticleSmootherSettings | None = None,
    *,
    all_stamps: bool = True,
) -> PathSamples:
    """Draw paths from the joint smoothing density.

    Parameters
    ----------
    history : CloudHistory
        Clouds of the filter and the odometry between them.
    seed : int or numpy Generator
        Source of all randomness; the same seed gives the same paths.
    settings : ParticleSmootherSettings
        How the smoother behaves.
    all_stamps : bool
        Poses at the end of every increment up to the last record; otherwise at the records only.

    Raises
    ------
    SkyfixError
        When nothing was recorded.
    """
    settings = settings or ParticleSmootherSettings()
    clouds, motions = history.clouds, history.motions
    if not clouds:
        raise SkyfixError("history: expected at least one recorded cloud, got none")
    rng = np.random.default_rng(seed)
    floor = np.diag([settings.floor_m, settings.floor_m, settings.floor_rad]) ** 2
    last = rng.choice(len(clouds[-1].weights), size=settings.paths, p=clouds[-1].weights)
    at_records = np.empty((settings.paths, len(clouds), 3))
    at_records[:, -1] = clouds[-1].particles[last]
    accepted, jumped = 0, np.zeros((settings.paths, len(clouds) - 1), dtype=np.bool_)
    for t in range(len(clouds) - 2, -1, -1):
        cloud, motion = clouds[t], accumulate(motions[t])
        whiten = np.linalg.inv(np.linalg.cholesky(motion.covariance + floor))
        later = np.ascontiguousarray(at_records[:, t + 1])
        jumped[:, t] = _jumps(cloud, clouds[t + 1].jump_density, later, motion.delta, whiten, rng)
        stays = ~jumped[:, t]
        before, found = step_back(
            cloud.particles, cloud.weights, later[stays], motion.delta, whiten, settings.max_rejections, rng
        )
        at_records[stays, t] = cloud.particles[before]
        anyone = rng.choice(len(cloud.weights), size=settings.paths - len(before), p=cloud.weights)
        at_records[~stays, t] = cloud.particles[anyone]
        accepted += found
    steps = jumped.size - int(jumped.sum())
    share = accepted / steps if steps else 1.0
    jumped = read_only(jumped)
    if not all_stamps:
        stamps = np.array([cloud.stamp_ns for cloud in clouds], dtype=np.int64)
        return PathSamples(read_only(stamps), read_only(at_records), share, jumped)
    stamp_list, pieces = [clouds[0].stamp_ns], [at_records[:, :1]]
    for t, motion_between in enumerate(motions):
        ends = at_records[:, t + 1].copy()
        ends[jumped[:, t]] = _driven(at_records[jumped[:, t], t], accumulate(motion_between), rng)
        between = bridge(at_records[:, t], ends, motion_between, rng)
        pieces += [between, at_records[:, t + 1 : t + 2]]
        stamp_list += [increment.stamp_ns for increment in motion_between]
    paths = np.concatenate(pieces, axis=1)
    return PathSamples(read_only(np.array(stamp_list, dtype=np.int64)), read_only(paths), share, jumped)


def _jumps(
    cloud: RecordedCloud,
    jump_density: float,
    later: FloatArray,
    delta: FloatArray,
    whiten: FloatArray,
    rng: np.random.Generator,
) -> BoolArray:
    """Whether each of the poses (M, 3) at the later record came from anywhere, drawn."""
    if jump_density == 0.0:
        return np.zeros(len(later), dtype=np.bool_)
    by_odometry = motion_density(cloud.particles, cloud.weights, later, delta, whiten)
    return rng.random(len(later)) * (by_odometry + jump_density) < jump_density


def _driven(poses: FloatArray, motion: OdometryIncrement, rng: np.random.Generator) -> FloatArray:
    """Where the odometry and its noise take poses (n, 3)."""
    noise = rng.standard_normal((len(poses), 3)) @ matrix_root(motion.covariance).T
    return se2.compose(poses, motion.delta + noise)
