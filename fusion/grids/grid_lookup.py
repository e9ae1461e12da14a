"""A likelihood at every cell of a lattice of poses, and the mass times it.

A `LikelihoodVolume`, with or without outliers, is looked up by compiled loops: its headings are interpolated once for
all and brought to the front, then every plane is interpolated on its own, where the parts of a cell are the same all
over. The result is that of its `log_density` at the poses of the cells. Any other likelihood is asked for just that.
"""

from dataclasses import dataclass

import numba
import numpy as np

from fusion import se2
from fusion.arrays import Float32Array, FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.grids.pose_lattice import PoseLattice
from fusion.grids.scratch import Scratch
from fusion.likelihood import LikelihoodVolume, OutlierMixture, PoseLikelihood, log_uniform_density

_BLOCK = 64
_FAR_M = 1e7


@dataclass(frozen=True, slots=True, eq=False)
class LookedUp:
    """Weights ``exp(log density - log_scale)`` on a lattice.

    Parameters
    ----------
    weights : (K, rows, cols) float32
        At most 1 where the likelihood peaks on a cell; never negative.
    log_scale : float
        ln density per m^2 rad of a weight of 1.
    outside : float
        Weight of a pose far from everything.
    """

    weights: Float32Array
    log_scale: float
    outside: float


def look_up(measurement: PoseLikelihood, lattice: PoseLattice, out: Float32Array, scratch: Scratch) -> LookedUp:
    """Weights of a likelihood at all cells of a lattice, into `out` (K, rows, cols).

    Raises
    ------
    SkyfixError
        When the likelihood gives NaN or an infinity.
    """
    far = np.array([[measurement.grid.x0 - _FAR_M, measurement.grid.y0 - _FAR_M, 0.0]])
    inner, probability = measurement, 0.0
    if isinstance(measurement, OutlierMixture):
        inner, probability = measurement.likelihood, measurement.probability
    if isinstance(inner, LikelihoodVolume):
        log_scale = float(inner.bin_peaks.max())
        uniform = probability * np.exp(log_uniform_density(inner.grid) - log_scale)
        planes = scratch.take((lattice.shape[0], *inner.log_prob.shape[:2]))
        _look_up_volume(inner, lattice, planes, 1.0 - probability, float(uniform), log_scale, out)
    else:
        for plane in range(lattice.shape[0]):
            out[plane] = _finite(measurement, lattice.poses(plane)).reshape(lattice.shape[1:])
        log_scale = float(out.max())
        np.exp(np.subtract(out, np.float32(log_scale), out=out), out=out)
    return LookedUp(out, log_scale, float(np.exp(_finite(measurement, far)[0] - log_scale)))


def _finite(measurement: PoseLikelihood, poses: FloatArray) -> FloatArray:
    values = np.asarray(measurement.log_density(poses), dtype=np.float64)
    if values.shape != (len(poses),) or not np.isfinite(values).all():
        raise SkyfixError(f"likelihood: expected {len(poses)} finite log densities, got others")
    return values


def _look_up_volume(
    volume: LikelihoodVolume,
    lattice: PoseLattice,
    planes: Float32Array,
    right: float,
    uniform: float,
    log_scale: float,
    out: Float32Array,
) -> None:
    bins = volume.log_prob.shape[2]
    turns = lattice.headings / se2.TWO_PI
    at = (turns - np.floor(turns)) * bins
    low = at.astype(np.int64)
    _headings_first(volume.log_prob, low % bins, (low + 1) % bins, (at - low).astype(np.float32), planes)
    first = lattice.grid.xy_from_pixel(lattice.offsets + 0.5)  # centre of the cell (0, 0) of every plane
    origin = volume.grid.pixel_from_xy(first) - 0.5
    ratio = lattice.grid.metres_per_pixel / volume.grid.metres_per_pixel
    ratio = 1.0 if abs(ratio - 1.0) < 1e-12 else ratio
    _look_up_planes(planes, origin, ratio, volume.floor, right, uniform, log_scale, out)


@numba.njit(cache=True, fastmath=True, nogil=True)
def _headings_first(
    log_prob: Float32Array, low: IntArray, high: IntArray, part: Float32Array, planes: Float32Array
) -> None:
    """From (rows, cols, bins) to (K, rows, cols), between the bins `low` and `high`, in blocks that fit the cache."""
    rows, cols = log_prob.shape[:2]
    for r in range(rows):
        for start in range(0, cols, _BLOCK):
            stop = min(start + _BLOCK, cols)
            for k in range(len(low)):
                a, b, f = low[k], high[k], part[k]
                for c in range(start, stop):
                    value = log_prob[r, c, a]
                    planes[k, r, c] = value + f * (log_prob[r, c, b] - value)


@numba.njit(cache=True, inline="always")
def _exp(x: np.float32) -> np.float32:
    """e^x for x in [-87, 88], relative error 1e-7, without branches: 2^n times a polynomial (Cephes' coefficients)."""
    n = np.floor(x * np.float32(1.44269504) + np.float32(0.5))
    r = x - n * np.float32(0.693359375) + n * np.float32(2.12194440e-4)
    p = np.float32(1.9875691500e-4) * r + np.float32(1.3981999507e-3)
    p = p * r + np.float32(8.3334519073e-3)
    p = p * r + np.float32(4.1665795894e-2)
    p = p * r + np.float32(1.6666665459e-1)
    p = p * r + np.float32(5.0000001201e-1)
    power = np.int32((np.int32(n) + np.int32(127)) << np.int32(23)).view(np.float32)
    return power * (p * r * r + r + np.float32(1.0))


@numba.njit(cache=True, inline="always")
def _inside(origin: float, ratio: float, count: int, size: int) -> tuple[int, int]:
    """First and last + 1 of the `count` cells whose centre lies on a raster of `size` pixels."""
    first = min(max(int(np.ceil((-0.5 - origin) / ratio - 1e-9)), 0), count)
    last = min(max(int(np.floor((size - 0.5 - origin) / ratio + 1e-9)) + 1, first), count)
    return first, last


@numba.njit(cache=True, fastmath=True, nogil=True)
def _look_up_planes(
    planes: Float32Array,
    origin: FloatArray,
    ratio: float,
    floor: float,
    right: float,
    uniform: float,
    log_scale: float,
    out: Float32Array,
) -> None:
    """``right * exp(l - log_scale) + uniform`` at every cell; l is bilinear in a plane, `floor` outside of it.

    Cell (r, c) of plane k lies at the pixel centre ``origin[k] + ratio * (r, c)``; what lies between the outermost
    centres and the edge takes the edge's value.
    """
    rows, cols = out.shape[1:]
    high, wide = planes.shape[1:]
    share, even, scale = np.float32(right), np.float32(uniform), np.float32(log_scale)
    lowest, least = np.float32(floor), np.float32(-87.0)
    nothing = share * _exp(max(lowest - scale, least)) + even
    line = np.empty(wide + 1, dtype=np.float32)
    for k in range(out.shape[0]):
        top, bottom = _inside(origin[k, 0], ratio, rows, high)
        begin, end = _inside(origin[k, 1], ratio, cols, wide)
        out[k, :top] = nothing
        out[k, bottom:] = nothing
        for r in range(top, bottom):
            at = min(max(origin[k, 0] + ratio * r, 0.0), high - 1.0)
            row = int(at)
            down = np.float32(at - row)
            upper, lower = planes[k, row], planes[k, min(row + 1, high - 1)]
            for c in range(wide):
                line[c] = upper[c] + down * (lower[c] - upper[c])
            line[wide] = line[wide - 1]
            target = out[k, r]
            target[:begin] = nothing
            target[end:] = nothing
            start, stop = begin, end
            if ratio == 1.0:  # whole rows at once, but for the two ends
                whole = int(np.floor(origin[k, 1]))
                across = np.float32(origin[k, 1] - whole)
                start, stop = max(begin, -whole), min(end, wide - whole)
                count = max(stop - start, 0)
                before, after = line[start + whole :], line[start + whole + 1 :]
                values = target[start:]
                for c in range(count):
                    values[c] = before[c] + across * (after[c] - before[c])
                stop = start + count
            else:
                stop = start
            for c in range(begin, end):
                if start <= c < stop:
                    continue
                place = min(max(origin[k, 1] + ratio * c, 0.0), wide - 1.0)
                col = int(place)
                target[c] = line[col] + np.float32(place - col) * (line[col + 1] - line[col])
            values = target[begin:end]
            for c in range(end - begin):
                values[c] = share * _exp(max(max(values[c], lowest) - scale, least)) + even
