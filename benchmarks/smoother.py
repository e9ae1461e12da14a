"""Smoothing a drive: skyfix's factor graph beside GTSAM's optimizer and scipy, same factors, same start.

Every node has one Gaussian measurement and none is an outlier, odometry has no robust loss, so that all implementations
minimise the same sum of squares. skyfix gets them as Gaussians, and once more as whole likelihoods on grids of cells;
so does GTSAM's optimizer, through callbacks. Peers that are slower by far are left out of the longest drive. skyfix
gives a covariance for every node on top; the peers give the poses only. Drive and measurements are drawn by formula
from a seed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import bsr_array, csr_array
from scipy.sparse.linalg import spsolve

from benchmarks.custom_factors import add_likelihoods
from benchmarks.runner import Candidate, Case
from fusion import (
    GaussianMixture,
    MapGrid,
    OdometryIncrement,
    OdometryNoise,
    SmootherResult,
    SmootherSettings,
    Trajectory,
    UniformPrior,
    se2,
    smooth,
)
from fusion.arrays import FloatArray, IntArray
from fusion.graph.patch import LikelihoodPatch
from fusion.likelihood import log_uniform_density

SIZES = (250, 1_000, 2_000, 20_000)
_MOST_FOR_SLOW_PEERS = 2_000
SEED = 0
_FLOOR = -40.0
SETTINGS = SmootherSettings(outlier_probability=1e-6, odometry_kernel="none")
_STEP_TOLERANCE = 1e-9  # metres and radians
_MOST_STEPS = 50


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """What a smoother is given."""

    stamps_ns: IntArray
    increments: list[OdometryIncrement]
    measurements: list[GaussianMixture]
    prior: UniformPrior
    start: Trajectory


def example_drive(nodes: int) -> Drive:
    """A winding drive with a node every 2 m; the start values are off as a filter's are."""
    rng = np.random.default_rng(SEED)
    noise = OdometryNoise()
    measured = np.diag([0.7, 0.7, np.deg2rad(2.0)]) ** 2
    off = np.diag([0.4, 0.4, np.deg2rad(1.0)]) ** 2
    truth, increments = [np.zeros(3)], []
    for node in range(1, nodes):
        delta = np.array([2.0, 0.0, 0.05 * np.sin(0.03 * node)])
        covariance = noise.covariance(delta, seconds=0.2)
        truth.append(se2.compose(truth[-1], delta))
        drawn = delta + rng.multivariate_normal(np.zeros(3), covariance)
        increments.append(OdometryIncrement(node, drawn, covariance))
    stamps = np.arange(nodes)
    means = np.array(truth) + rng.multivariate_normal(np.zeros(3), measured, nodes)
    poses = np.array(truth) + rng.multivariate_normal(np.zeros(3), off, nodes)
    poses[:, 2] = se2.wrap(poses[:, 2])
    mixtures = [GaussianMixture(np.ones(1), mean[None], measured[None]) for mean in means]
    start = Trajectory(stamps, poses, np.repeat(off[None], nodes, axis=0))
    return Drive(stamps, increments, mixtures, UniformPrior(np.zeros(3), 20.0, np.deg2rad(10.0)), start)


def skyfix_smooth(drive: Drive) -> SmootherResult:
    """skyfix's answer."""
    return smooth(drive.stamps_ns, drive.increments, drive.measurements, drive.prior, drive.start, SETTINGS)


def skyfix_whole(drive: Drive, patches: Sequence[LikelihoodPatch]) -> SmootherResult:
    """skyfix's answer from the measurements as cells of log density."""
    return smooth(drive.stamps_ns, drive.increments, patches, drive.prior, drive.start, SETTINGS)


def whole_likelihoods(drive: Drive) -> list[LikelihoodPatch]:
    """The Gaussians as cells."""
    return [patch_around(mixture) for mixture in drive.measurements]


def patch_around(mixture: GaussianMixture) -> LikelihoodPatch:
    """A Gaussian on a grid of 1 m and 1 degree, 10 m and 12 degrees around."""
    corner, first = np.floor(mixture.means[0, :2]) - 10.0, round(float(np.rad2deg(mixture.means[0, 2]))) - 12
    grid = MapGrid(21, 21, 1.0, *corner.tolist())
    x, y = grid.centres()
    yaw = np.deg2rad(first + np.arange(25.0))
    poses = np.stack(np.meshgrid(y, x, yaw, indexing="ij"), axis=-1)[..., [1, 0, 2]]
    values = np.maximum(mixture.log_density(poses.reshape(-1, 3)), _FLOOR).reshape(poses.shape[:3])
    return LikelihoodPatch(values.astype(np.float32), grid, first, 360, _FLOOR, log_uniform_density(grid))


def gtsam_levenberg_marquardt(drive: Drive, patches: Sequence[LikelihoodPatch] | None = None) -> FloatArray:
    """Poses (N, 3) by GTSAM's optimizer, every measurement a prior factor; or a callback, when they are patches."""
    problem = LeastSquares.of(drive)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noises = [gtsam.noiseModel.Gaussian.SqrtInformation(root, False) for root in problem.root_information]
    expected = [gtsam.Pose2(x, y, yaw) for x, y, yaw in problem.expected.tolist()]
    absolute = len(problem.node)
    native = absolute if patches is None else 1
    for node, pose, noise in zip(problem.node[:native].tolist(), expected[:native], noises[:native], strict=True):
        graph.add(gtsam.PriorFactorPose2(node, pose, noise))
    if patches is not None:
        add_likelihoods(graph, patches)
    for node, (motion, noise) in enumerate(zip(expected[absolute:], noises[absolute:], strict=True)):
        graph.add(gtsam.BetweenFactorPose2(node, node + 1, motion, noise))
    for node, (x, y, yaw) in enumerate(drive.start.poses.tolist()):
        values.insert(node, gtsam.Pose2(x, y, yaw))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.array(gtsam.utilities.extractPose2(found)).reshape(-1, 3)


def scipy_least_squares(drive: Drive) -> FloatArray:
    """Poses (N, 3) by `scipy.optimize.least_squares` with the sparse analytical Jacobian.

    Scaled, and with inner steps solved to the end: as it comes it needs ten times as long and stops a millimetre off.
    """
    problem = LeastSquares.of(drive)
    found = least_squares(
        problem.residuals,
        drive.start.poses.ravel(),
        jac=problem.jacobian,
        x_scale="jac",
        tr_solver="lsmr",
        tr_options={"regularize": False, "atol": 1e-10, "btol": 1e-10},
        xtol=_STEP_TOLERANCE,
        ftol=1e-10,
        gtol=None,
    )
    return _poses(found.x)


def scipy_gauss_newton(drive: Drive) -> FloatArray:
    """Poses (N, 3) by Gauss-Newton steps, each a sparse LU of the normal equations: the quickest way in scipy."""
    problem = LeastSquares.of(drive)
    x = drive.start.poses.ravel()
    for _ in range(_MOST_STEPS):
        jacobian = problem.jacobian(x)
        step = spsolve((jacobian.T @ jacobian).tocsc(), -(jacobian.T @ problem.residuals(x)))
        x = x + step
        if np.abs(step).max() < _STEP_TOLERANCE:
            break
    return _poses(x)


def _poses(x: FloatArray) -> FloatArray:
    poses = x.reshape(-1, 3).copy()
    poses[:, 2] = se2.wrap(poses[:, 2])
    return poses


@dataclass(frozen=True, slots=True, eq=False)
class LeastSquares:
    """The factors of a drive as whitened residuals of a vector of 3 N coordinates, and their Jacobian.

    A factor that expects the pose z and sees the pose h(x) has the residual ``W log(z^-1 h(x))``, GTSAM's; W is the
    root of the information on the axes of z. Absolute factors come first (the prior, then the measurements), and then
    those of the odometry, from each node to the next.
    """

    node: IntArray
    expected: FloatArray
    root_information: FloatArray

    @classmethod
    def of(cls, drive: Drive) -> LeastSquares:
        """Stack the factors of a drive."""
        mixtures, increments = drive.measurements, drive.increments
        expected = [drive.prior.mean, *(m.means[0] for m in mixtures), *(i.delta for i in increments)]
        covariances = [drive.prior.covariance, *(m.covariances[0] for m in mixtures)]
        turn = se2.rotation(-np.array(expected)[:, 2])
        turned = turn @ np.array([*covariances, *(i.covariance for i in increments)]) @ turn.swapaxes(1, 2)
        node = np.concatenate([[0], np.arange(len(mixtures))])
        return cls(node, np.array(expected), np.linalg.inv(np.linalg.cholesky(turned)))

    def _seen(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Poses (N, 3), and what every factor sees of them (F, 3)."""
        poses = x.reshape(-1, 3)
        return poses, np.concatenate([poses[self.node], se2.between(poses[:-1], poses[1:])])

    def residuals(self, x: FloatArray) -> FloatArray:
        """Whitened residuals (3 F,)."""
        error = se2.log(se2.between(self.expected, self._seen(x)[1]))
        return np.einsum("fij,fj->fi", self.root_information, error).ravel()

    def jacobian(self, x: FloatArray) -> csr_array:
        """Derivative (3 F, 3 N) of the residuals."""
        poses, seen = self._seen(x)
        error = se2.between(self.expected, seen)
        by_seen = self.root_information @ log_derivative(error) @ se2.rotation(-self.expected[:, 2])
        absolute, relative = np.split(by_seen, [len(self.node)])
        second = se2.rotation(-poses[:-1, 2])
        first = -second
        first[:, 0, 2] = seen[len(self.node) :, 1]
        first[:, 1, 2] = -seen[len(self.node) :, 0]
        chain = np.stack([relative @ first, relative @ second], axis=1).reshape(-1, 3, 3)
        begin = np.arange(len(poses) - 1)
        columns = np.concatenate([self.node, np.stack([begin, begin + 1], axis=1).ravel()])
        rows = np.concatenate([np.arange(len(self.node)), len(self.node) + 2 * np.arange(len(poses))])
        blocks = np.concatenate([absolute, chain])
        return bsr_array((blocks, columns, rows), shape=(3 * len(seen), x.size)).tocsr()


def log_derivative(pose: FloatArray) -> FloatArray:
    """Derivative (N, 3, 3) of `fusion.se2.log` by the coordinates of small poses (N, 3), |yaw| < 2 pi."""
    x, y, yaw = pose.T
    half = 0.5 * yaw
    a = np.cos(half) / np.sinc(half / np.pi)  # (w / 2) cot(w / 2)
    small = np.abs(yaw) < 1e-3
    sin = np.where(small, 1.0, np.sin(half))
    slope = np.where(small, -yaw / 6.0, 0.5 * (np.cos(half) / sin - half / sin**2))
    derivative = np.zeros((len(pose), 3, 3))
    derivative[:, 0, 0] = derivative[:, 1, 1] = a
    derivative[:, 0, 1], derivative[:, 1, 0] = half, -half
    derivative[:, 0, 2] = slope * x + 0.5 * y
    derivative[:, 1, 2] = slope * y - 0.5 * x
    derivative[:, 2, 2] = 1.0
    return derivative


def cases(sizes: Sequence[int] = SIZES) -> Iterator[Case]:
    """One case a number of nodes."""
    for size in sizes:
        yield _case(example_drive(size), size)


def _case(drive: Drive, size: int) -> Case:
    patches = whole_likelihoods(drive)
    candidates = [
        Candidate("skyfix smooth, whole likelihoods, with covariances", lambda: lambda: skyfix_whole(drive, patches)),
        Candidate("skyfix smooth, Gaussians, with covariances", lambda: lambda: skyfix_smooth(drive)),
        Candidate("GTSAM Levenberg-Marquardt, poses only", lambda: lambda: gtsam_levenberg_marquardt(drive)),
        Candidate("scipy Gauss-Newton, sparse LU, poses only", lambda: lambda: scipy_gauss_newton(drive)),
    ]
    if size <= _MOST_FOR_SLOW_PEERS:
        candidates += [
            Candidate("scipy least_squares, sparse Jacobian, poses only", lambda: lambda: scipy_least_squares(drive)),
            Candidate(
                "GTSAM Levenberg-Marquardt, a CustomFactor a likelihood, poses only",
                lambda: lambda: gtsam_levenberg_marquardt(drive, patches),
            ),
        ]
    return Case("chain", size, tuple(candidates))
