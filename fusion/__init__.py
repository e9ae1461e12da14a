"""Fusion of map-localization likelihoods with odometry: poses, likelihoods, a particle filter and a factor graph.

This package knows nothing of networks, sensors or files, so that any likelihood and any odometry can be plugged in.
"""

from fusion.emulation.emulated_likelihood import EmulatedLikelihood
from fusion.emulation.error_profile import (
    FG2_KITTI_SAME_AREA,
    ORIENTERNET_KITTI_SEQUENTIAL,
    TRANSLOCNET_KITTI,
    ErrorProfile,
    PublishedFigures,
)
from fusion.emulation.likelihood_emulator import EmulatorSettings, LikelihoodEmulator
from fusion.error_correlation import ErrorCorrelation, estimate_error_correlation
from fusion.errors import SkyfixError
from fusion.estimate import Estimate
from fusion.factor_graph import AbsoluteFix, LoopClosure, OdometryDrift, SmootherResult, SmootherSettings, smooth
from fusion.fixed_lag import FixedLagSettings, FixedLagSmoother, LagCounts, LagReport, LagState
from fusion.gaussian_likelihood import GaussianLikelihood
from fusion.gaussian_mixture import GaussianMixture
from fusion.graph.likelihood_factors import LikelihoodFactors
from fusion.graph_filter import FilterAndGraph, GraphFilter
from fusion.grid import MapGrid
from fusion.grid_filter import GridFilter, GridFilterSettings
from fusion.grid_smoother import GridSmootherResult, smooth_on_grid
from fusion.grids.pose_lattice import PoseLattice
from fusion.hypotheses import Hypothesis, HypothesisSettings, HypothesisSmoother, HypothesisState
from fusion.incremental import IncrementalSettings, IncrementalSmoother
from fusion.kalman_filter import KalmanFilter, KalmanFilterSettings
from fusion.lazy_orientation import LazyOrientation
from fusion.likelihood import LikelihoodVolume, OutlierMixture, PoseLikelihood
from fusion.location_orientation import LocationOrientationMaps
from fusion.modes import find_modes
from fusion.odometry import OdometryIncrement, OdometryNoise, accumulate, increments_at
from fusion.odometry_calibration import calibrate_odometry
from fusion.odometry_doubts import OdometryDoubts, believed_odometry
from fusion.odometry_errors import OdometryCalibration
from fusion.odometry_limits import MotionKind, OdometryLimits
from fusion.particle_filter import ParticleFilter, ParticleFilterSettings, ParticleFilterState
from fusion.particle_smoother import ParticleSmootherSettings, PathSamples, sample_paths
from fusion.particles.cloud_history import CloudHistory, RecordedCloud
from fusion.particles.kld_sampling import KldSampling
from fusion.pose_filter import PoseFilter, UpdateReport
from fusion.prior import UniformPrior
from fusion.tracker import Tracker
from fusion.tracking.resumable import ResumableFilter
from fusion.tracking.tracker_report import Arrival, Measured, Outcome, Statistics
from fusion.tracking.tracker_settings import TrackerSettings
from fusion.trajectory import Trajectory

__all__ = [
    "FG2_KITTI_SAME_AREA",
    "ORIENTERNET_KITTI_SEQUENTIAL",
    "TRANSLOCNET_KITTI",
    "AbsoluteFix",
    "Arrival",
    "CloudHistory",
    "EmulatedLikelihood",
    "EmulatorSettings",
    "ErrorCorrelation",
    "ErrorProfile",
    "Estimate",
    "FilterAndGraph",
    "FixedLagSettings",
    "FixedLagSmoother",
    "GaussianLikelihood",
    "GaussianMixture",
    "GraphFilter",
    "GridFilter",
    "GridFilterSettings",
    "GridSmootherResult",
    "Hypothesis",
    "HypothesisSettings",
    "HypothesisSmoother",
    "HypothesisState",
    "IncrementalSettings",
    "IncrementalSmoother",
    "KalmanFilter",
    "KalmanFilterSettings",
    "KldSampling",
    "LagCounts",
    "LagReport",
    "LagState",
    "LazyOrientation",
    "LikelihoodEmulator",
    "LikelihoodFactors",
    "LikelihoodVolume",
    "LocationOrientationMaps",
    "LoopClosure",
    "MapGrid",
    "Measured",
    "MotionKind",
    "OdometryCalibration",
    "OdometryDoubts",
    "OdometryDrift",
    "OdometryIncrement",
    "OdometryLimits",
    "OdometryNoise",
    "Outcome",
    "OutlierMixture",
    "ParticleFilter",
    "ParticleFilterSettings",
    "ParticleFilterState",
    "ParticleSmootherSettings",
    "PathSamples",
    "PoseFilter",
    "PoseLattice",
    "PoseLikelihood",
    "PublishedFigures",
    "RecordedCloud",
    "ResumableFilter",
    "SkyfixError",
    "SmootherResult",
    "SmootherSettings",
    "Statistics",
    "Tracker",
    "TrackerSettings",
    "Trajectory",
    "UniformPrior",
    "UpdateReport",
    "accumulate",
    "believed_odometry",
    "calibrate_odometry",
    "estimate_error_correlation",
    "find_modes",
    "increments_at",
    "sample_paths",
    "smooth",
    "smooth_on_grid",
]
