"""Odometry made from the truth with drift like that of wheels and a gyroscope; called 'emulated' wherever it is used.

Every step is measured with a constant scale error, white noise that grows with the distance, and a heading bias
that wanders (an Ornstein-Uhlenbeck process over distance). Nothing is ever corrected, so the error of the whole
grows without bound.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion import se2
from fusion.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class EmulatedDrift:
    """Sizes of the errors.

    Attributes
    ----------
    scale
        Relative error of all distances.
    white_m_per_sqrt_m, white_deg_per_sqrt_m
        Standard deviations of position and heading noise after one metre.
    bias_deg_per_m, bias_length_m
        Standard deviation of the heading bias and the distance over which it changes.
    """

    scale: float = 0.01
    white_m_per_sqrt_m: float = 0.01
    white_deg_per_sqrt_m: float = 0.06
    bias_deg_per_m: float = 0.008
    bias_length_m: float = 150.0


def emulate_odometry(truth: Trajectory, seed: int, drift: EmulatedDrift | None = None) -> Trajectory:
    """Drifting trajectory in a frame of its own that starts at the origin, at the stamps of the truth."""
    drift = drift or EmulatedDrift()
    rng = np.random.default_rng(seed)
    steps = se2.between(truth.poses[:-1], truth.poses[1:])
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    bias = np.deg2rad(drift.bias_deg_per_m) * rng.standard_normal()
    poses = np.zeros((len(truth), 3))
    for i, (step, length) in enumerate(zip(steps, lengths, strict=True)):
        kept = np.exp(-length / drift.bias_length_m)
        bias = kept * bias + np.deg2rad(drift.bias_deg_per_m) * np.sqrt(1.0 - kept**2) * rng.standard_normal()
        noise = np.sqrt(length) * rng.standard_normal(3)
        measured = np.array(
            [
                step[0] * (1.0 + drift.scale) + drift.white_m_per_sqrt_m * noise[0],
                step[1] * (1.0 + drift.scale) + 0.5 * drift.white_m_per_sqrt_m * noise[1],
                step[2] + bias * length + np.deg2rad(drift.white_deg_per_sqrt_m) * noise[2],
            ]
        )
        poses[i + 1] = se2.compose(poses[i], measured)
    return Trajectory(truth.stamp_ns, poses, frame_id="emulated")
