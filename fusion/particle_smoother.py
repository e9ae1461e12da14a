"""The particle smoother: whole paths given all odometry and all measurements, from the clouds a filter left behind.

Forward filtering, backward simulation: a path starts at a particle of the last cloud and goes back record by record,
each time to a particle from which the odometry could have brought it where it is. M such paths are independent draws
of the joint smoothing density of the recorded stamps, multimodal or not. Between records the odometry's own
conditional density fills in the other stamps (see `odometry_bridge`).

Where a filter was lost and drew particles anew, no odometry leads back: paths then go on from the particle nearest in
the odometry's metric, and their spread says nothing of how wrong the cloud before was. As many nodes as measurements,
a few metres apart, are better than many more: the finer the step, the fewer particles could have led to a particle.

Sources: Godsill, Doucet, West, "Monte Carlo smoothing for nonlinear time series", JASA 2004; Douc, Garivier,
Moulines, Olsson, "Sequential Monte Carlo smoothing for general state space hidden Markov models", Annals of Applied
Probability 2011.
"""

from dataclasses import dataclass

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, IntArray, read_only
from fusion.errors import SkyfixError
from fusion.kernels.backward import step_back
from fusion.odometry import accumulate
from fusion.particles.cloud_history import CloudHistory
from fusion.particles.clusters import VARIANCE_FLOOR
from fusion.particles.odometry_bridge import bridge
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
        Share of the steps back that rejection sampling settled.
    """

    stamp_ns: IntArray
    paths: FloatArray
    accepted_share: float

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
    accepted = 0
    for t in range(len(clouds) - 2, -1, -1):
        motion = accumulate(motions[t])
        whiten = np.linalg.inv(np.linalg.cholesky(motion.covariance + floor))
        later = np.ascontiguousarray(at_records[:, t + 1])
        before, found = step_back(
            clouds[t].particles, clouds[t].weights, later, motion.delta, whiten, settings.max_rejections, rng
        )
        at_records[:, t] = clouds[t].particles[before]
        accepted += found
    steps = settings.paths * (len(clouds) - 1)
    share = accepted / steps if steps else 1.0
    if not all_stamps:
        stamps = np.array([cloud.stamp_ns for cloud in clouds], dtype=np.int64)
        return PathSamples(read_only(stamps), read_only(at_records), share)
    stamp_list, pieces = [clouds[0].stamp_ns], [at_records[:, :1]]
    for t, motion_between in enumerate(motions):
        between = bridge(at_records[:, t], at_records[:, t + 1], motion_between, rng)
        pieces += [between, at_records[:, t + 1 : t + 2]]
        stamp_list += [increment.stamp_ns for increment in motion_between]
    paths = np.concatenate(pieces, axis=1)
    return PathSamples(read_only(np.array(stamp_list, dtype=np.int64)), read_only(paths), share)
