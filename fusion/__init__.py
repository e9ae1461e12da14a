"""Fusion of map-localization likelihoods with odometry: poses, likelihoods, a particle filter and a factor graph.

This package knows nothing of networks, sensors or files, so that any likelihood and any odometry can be plugged in.
"""

from fusion.cloud_history import CloudHistory, RecordedCloud
from fusion.emulated_likelihood import EmulatedLikelihood
from fusion.error_correlation import ErrorCorrelation, estimate_error_correlation
from fusion.error_profile import (
    FG2_KITTI_SAME_AREA,
    ORIENTERNET_KITTI_SEQUENTIAL,
    TRANSLOCNET_KITTI,
    ErrorProfile,
    PublishedFigures,
)
from fusion.errors import SkyfixError
from fusion.estimate import Estimate
from fusion.factor_graph import SmootherResult, SmootherSettings, smooth
from fusion.gaussian_likelihood import GaussianLikelihood
from fusion.gaussian_mixture import GaussianMixture
from fusion.grid import MapGrid
from fusion.grid_filter import GridFilter, GridFilterSettings
from fusion.grid_smoother import GridSmootherResult, smooth_on_grid
from fusion.kalman_filter import KalmanFilter, KalmanFilterSettings
from fusion.kld_sampling import KldSampling
from fusion.lazy_orientation import LazyOrientation
from fusion.likelihood import LikelihoodVolume, OutlierMixture, PoseLikelihood
from fusion.likelihood_emulator import EmulatorSettings, LikelihoodEmulator
from fusion.location_orientation import LocationOrientationMaps
from fusion.modes import find_modes
from fusion.odometry import OdometryIncrement, OdometryNoise, accumulate, increments_at
from fusion.odometry_calibration import OdometryCalibration, calibrate_odometry
from fusion.odometry_limits import MotionKind, OdometryLimits
from fusion.particle_filter import ParticleFilter, ParticleFilterSettings, ParticleFilterState
from fusion.particle_smoother import ParticleSmootherSettings, PathSamples, sample_paths
from fusion.pose_filter import PoseFilter, UpdateReport
from fusion.pose_lattice import PoseLattice
from fusion.prior import UniformPrior
from fusion.resumable import ResumableFilter
from fusion.tracker import Tracker
from fusion.tracker_report import Arrival, Measured, Outcome, Statistics
from fusion.tracker_settings import TrackerSettings
from fusion.trajectory import Trajectory

__all__ = [
    "FG2_KITTI_SAME_AREA",
    "ORIENTERNET_KITTI_SEQUENTIAL",
    "TRANSLOCNET_KITTI",
    "Arrival",
    "CloudHistory",
    "EmulatedLikelihood",
    "EmulatorSettings",
    "ErrorCorrelation",
    "ErrorProfile",
    "Estimate",
    "GaussianLikelihood",
    "GaussianMixture",
    "GridFilter",
    "GridFilterSettings",
    "GridSmootherResult",
    "KalmanFilter",
    "KalmanFilterSettings",
    "KldSampling",
    "LazyOrientation",
    "LikelihoodEmulator",
    "LikelihoodVolume",
    "LocationOrientationMaps",
    "MapGrid",
    "Measured",
    "MotionKind",
    "OdometryCalibration",
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
    "calibrate_odometry",
    "estimate_error_correlation",
    "find_modes",
    "increments_at",
    "sample_paths",
    "smooth",
    "smooth_on_grid",
]
