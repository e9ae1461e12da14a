"""What a tracker checks of what it is given, before any of it is touched."""

import numpy as np
from numpy.typing import ArrayLike

from fusion import se2
from fusion.arrays import FloatArray, checked, read_only
from fusion.errors import SkyfixError
from fusion.likelihood import PoseLikelihood
from fusion.odometry import OdometryIncrement
from fusion.tracking.odometry_buffer import OdometrySample

_LARGEST = 1e8  # metres and radians: beyond it float64 knows less than a micrometre


def checked_whole(name: str, value: object, least: int) -> int:
    """A whole number that is not less than another."""
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < least:
        raise SkyfixError(f"{name}: expected a whole number >= {least}, got {value!r}")
    return int(value)


def checked_stamp(stamp_ns: object) -> int:
    """A stamp as int, after making sure that it is one: float seconds must be converted where they are read."""
    if not isinstance(stamp_ns, (int, np.integer)) or isinstance(stamp_ns, bool):
        raise SkyfixError(f"stamp: expected int64 nanoseconds, got {type(stamp_ns).__name__} {stamp_ns!r}")
    if not -(2**63) < stamp_ns < 2**63:
        raise SkyfixError(f"stamp: expected int64 nanoseconds, got {stamp_ns}")
    return int(stamp_ns)


def checked_pose(stamp_ns: object, pose: ArrayLike) -> OdometrySample:
    """A pose of an odometry with its stamp."""
    return OdometrySample(checked_stamp(stamp_ns), _checked_motion("odometry pose", pose))


def checked_increment(increment: object) -> OdometrySample:
    """A motion of an odometry with its stamp and covariance."""
    if not isinstance(increment, OdometryIncrement):
        raise SkyfixError(f"increment: expected an OdometryIncrement, got {type(increment).__name__}")
    largest = float(np.abs(increment.covariance).max())
    if largest > _LARGEST:
        raise SkyfixError(f"increment covariance: expected at most {_LARGEST:g}, got {largest:g}")
    value = _checked_motion("increment delta", increment.delta)
    return OdometrySample(checked_stamp(increment.stamp_ns), value, increment.covariance)


def _checked_motion(name: str, value: ArrayLike) -> FloatArray:
    motion = checked(name, value, (3,)).copy()
    if np.abs(motion).max() > _LARGEST:
        raise SkyfixError(f"{name}: expected at most {_LARGEST:g}, got {np.abs(motion).max():g}")
    motion[2] = se2.wrap(motion[2])
    return read_only(motion)


def check_likelihood(likelihood: PoseLikelihood) -> None:
    """Try a likelihood at the middle of its crop: what gives no number there is refused before it can do harm."""
    try:
        pose = np.append(likelihood.grid.centre_xy, 0.0)
        density = np.asarray(likelihood.log_density(pose[None]), dtype=np.float64)
    except (AttributeError, TypeError) as error:
        raise SkyfixError(f"likelihood: expected a PoseLikelihood, got {type(likelihood).__name__}") from error
    if density.shape != (1,) or not np.isfinite(density).all():
        raise SkyfixError(f"likelihood: expected one finite log density at one pose, got {density}")


def one_line(error: Exception, stamp_ns: int) -> SkyfixError:
    """What the filter had against a likelihood, as the library's own error."""
    if isinstance(error, SkyfixError):
        return error
    text = " ".join(str(error).split())
    return SkyfixError(f"likelihood at {stamp_ns} ns: expected log densities, got {type(error).__name__}: {text}")
