"""How held-out samples are simulated: for validation while training, for calibration after it, and for evaluation.

All are of the extract that is not trained on, each kind with a seed of its own. The latter two are seen to the reach
that the network is used with, over a map that holds every search.
"""

from __future__ import annotations

from dataclasses import replace

from sequences.train_config import TrainConfig
from sequences.training_data import SimulationSettings

HELD_OUT_HALF_EXTENT_M = 20.0
"""Half the side of the squares of positions that are searched in calibration."""
_VALIDATION_SEED_OFFSET, _EVALUATION_SEED_OFFSET = 1_000_000, 2_000_000


def validation_settings(config: TrainConfig) -> SimulationSettings:
    """Samples as in training."""
    return replace(
        config.simulation,
        samples=config.validation_samples,
        samples_per_area=4,
        seed=config.simulation.seed + _VALIDATION_SEED_OFFSET,
    )


def calibration_settings(config: TrainConfig) -> SimulationSettings:
    """Samples to fit the calibration on."""
    return _far(config, config.calibration_samples, HELD_OUT_HALF_EXTENT_M, _VALIDATION_SEED_OFFSET)


def evaluation_settings(config: TrainConfig, samples: int, half_extent_m: float) -> SimulationSettings:
    """Samples to compare networks on, from searches of a half extent; calibration has not seen them.

    Whatever worlds and sensors a network was trained in, these have drawn ones.
    """
    return replace(_far(config, samples, half_extent_m, _EVALUATION_SEED_OFFSET), world={}, sensor={})


def _far(config: TrainConfig, samples: int, half_extent_m: float, seed_offset: int) -> SimulationSettings:
    reach = config.matching_reach_m
    return replace(
        config.simulation,
        samples=samples,
        samples_per_area=4,
        seed=config.simulation.seed + seed_offset,
        bev_half_extent_m=reach,
        sample_px=4 * round(reach + 2 * half_extent_m + 2),
        area_half_extent_m=config.simulation.scan_half_extent_m + reach + 2 * half_extent_m + 4.0,
    )
