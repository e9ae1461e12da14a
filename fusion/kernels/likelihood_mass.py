"""Passes over a whole likelihood volume, once and in the first cache: extremes, size of the searched part, mass."""

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.kernels.float_math import KERNEL, F, bits_of, exp, larger

_RUN = 4096
_NOT_FINITE = np.int32(0x7F800000)


@numba.njit(**KERNEL)
def survey(values: NDArray[np.float32], floor: np.float32) -> tuple[NDArray[np.float32], np.int64, np.int64]:
    """Of log densities (cells, K): the largest of every column, the number above the floor, the number not finite."""
    cells, bins = values.shape
    peaks = np.full(bins, F(-3.4e38))
    evaluated, bad = np.int64(0), np.int64(0)
    for i in range(cells):
        above, odd = np.int32(0), np.int32(0)
        row = values[i]
        for k in range(bins):
            value = row[k]
            peaks[k] = larger(value, peaks[k])
            above += np.int32(1) if value > floor else np.int32(0)
            odd += np.int32(1) if np.int32(bits_of(value) & _NOT_FINITE) == _NOT_FINITE else np.int32(0)
        evaluated += np.int64(above)
        bad += np.int64(odd)
    return peaks, evaluated, bad


@numba.njit(**KERNEL)
def tempered_mass(
    values: NDArray[np.float32], floor: np.float32, peak: np.float32, share: np.float32
) -> tuple[float, F]:
    """Sum of ``exp((value - peak) * share)`` over the values (n,) above the floor, and the least of these."""
    mass, least = 0.0, F(3e38)
    for start in range(0, len(values), _RUN):
        part = values[start : min(start + _RUN, len(values))]
        total, lowest = F(0.0), F(-3e38)
        for j in range(len(part)):
            evaluated = part[j] > floor
            total += exp((part[j] - peak) * share) if evaluated else F(0.0)
            lowest = larger(-part[j] if evaluated else F(-3e38), lowest)
        mass += np.float64(total)
        least = -larger(lowest, -least)
    return mass, least


@numba.njit(**KERNEL)
def log_mass_of_maps(location: NDArray[np.float32], orientation: NDArray[np.float32], share: F) -> float:
    """ln of the sum of ``exp((location + orientation) * share)`` over pixels (P,) and headings (K, P)."""
    bins, pixels = orientation.shape
    largest = F(-3e38)
    for p in range(pixels):
        largest = larger(location[p], largest)
    mass = 0.0
    for k in range(bins):
        row = orientation[k]
        for start in range(0, pixels, _RUN):
            stop = min(start + _RUN, pixels)
            total = F(0.0)
            for p in range(start, stop):
                total += exp((location[p] - largest + row[p]) * share)
            mass += np.float64(total)
    return np.log(mass) + np.float64(largest * share)
