"""Fusion of map-localization likelihoods with odometry: poses, likelihoods, a particle filter and a factor graph.

This package knows nothing of networks, sensors or files, so that any likelihood and any odometry can be plugged in.
"""

from fusion.errors import SkyfixError
from fusion.estimate import Estimate
from fusion.factor_graph import SmootherResult, SmootherSettings, smooth
from fusion.gaussian_likelihood import GaussianLikelihood
from fusion.gaussian_mixture import GaussianMixture
from fusion.grid import MapGrid
from fusion.kld_sampling import KldSampling
from fusion.lazy_orientation import LazyOrientation
from fusion.likelihood import LikelihoodVolume, OutlierMixture, PoseLikelihood
from fusion.location_orientation import LocationOrientationMaps
from fusion.modes import find_modes
from fusion.odometry import OdometryIncrement, OdometryNoise, accumulate, increments_at
from fusion.particle_filter import ParticleFilter, ParticleFilterSettings
from fusion.pose_filter import PoseFilter, UpdateReport
from fusion.prior import UniformPrior
from fusion.trajectory import Trajectory

__all__ = [
    "Estimate",
    "GaussianLikelihood",
    "GaussianMixture",
    "KldSampling",
    "LazyOrientation",
    "LikelihoodVolume",
    "LocationOrientationMaps",
    "MapGrid",
    "OdometryIncrement",
    "OdometryNoise",
    "OutlierMixture",
    "ParticleFilter",
    "ParticleFilterSettings",
    "PoseFilter",
    "PoseLikelihood",
    "SkyfixError",
    "SmootherResult",
    "SmootherSettings",
    "Trajectory",
    "UniformPrior",
    "UpdateReport",
    "accumulate",
    "find_modes",
    "increments_at",
    "smooth",
]
