"""Casting beams into a 2.5-D world, compiled.

For every azimuth the kernel walks outward from cell to cell (Amanatides and Woo, "A fast voxel traversal
algorithm", 1987). Solids are a height field, so of the beams sorted by elevation the lowest unresolved one is
always the first to be hit: one pointer serves all beams and an azimuth costs O(cells + beams). Porous slabs return
a beam with a chance per metre of path; the random numbers are hashes of (seed, azimuth, beam, cell), so a scan does
not depend on the order of work.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sequences.world_model import DENSITY_STEP_PER_M, HEIGHT_STEP_M, Material

_BUILDING, _FOLIAGE = int(Material.BUILDING), int(Material.FOLIAGE)


@numba.njit(cache=True, inline="always")
def _uniform(seed: np.uint32, a: int, b: int, c: int) -> float:
    """Hash three counters to a number in [0, 1) (finaliser of MurmurHash3)."""
    h = np.uint32(seed ^ np.uint32(a) * np.uint32(0x9E3779B1))
    h = np.uint32(h ^ np.uint32(b) * np.uint32(0x85EBCA77))
    h = np.uint32(h ^ np.uint32(c) * np.uint32(0xC2B2AE3D))
    h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x85EBCA6B))
    h = np.uint32((h ^ (h >> np.uint32(13))) * np.uint32(0xC2B2AE35))
    h = np.uint32(h ^ (h >> np.uint32(16)))
    return float(h) * 2.3283064365386963e-10


@numba.njit(cache=True, fastmath=True, nogil=True)
def cast(
    surface: NDArray[np.float32],
    ground: NDArray[np.float32],
    canopy_bottom: NDArray[np.uint8],
    canopy_top: NDArray[np.uint8],
    canopy_density: NDArray[np.uint8],
    material: NDArray[np.uint8],
    row0: float,
    col0: float,
    step_m: float,
    sensor_z: float,
    headings: NDArray[np.float64],
    tangents: NDArray[np.float64],
    tilts: NDArray[np.float64],
    min_range: float,
    max_range: float,
    glass_share: float,
    seed: np.uint32,
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Horizontal distance (azimuths, beams) of every return, 0 where there is none, and the material hit."""
    beams = tangents.shape[0]
    rows, cols = surface.shape
    distance = np.zeros((headings.shape[0], beams))
    kind = np.zeros((headings.shape[0], beams), dtype=np.uint8)
    done = np.zeros(beams, dtype=np.bool_)
    slope = np.empty(beams)
    for a in range(headings.shape[0]):
        done[:] = False
        slope[:] = tangents + tilts[a]
        d_col, d_row = np.cos(headings[a]), -np.sin(headings[a])
        row, col = int(np.floor(row0)), int(np.floor(col0))
        step_row, step_col = (1 if d_row > 0 else -1), (1 if d_col > 0 else -1)
        big = 1e18
        per_row = step_m / abs(d_row) if abs(d_row) > 1e-12 else big
        per_col = step_m / abs(d_col) if abs(d_col) > 1e-12 else big
        next_row = per_row * ((row + 1 - row0) if d_row > 0 else (row0 - row)) if per_row < big else big
        next_col = per_col * ((col + 1 - col0) if d_col > 0 else (col0 - col)) if per_col < big else big
        lowest = 0
        entry = 0.0
        while lowest < beams and entry < max_range:
            leave = min(next_row, next_col)
            if entry >= min_range:
                top = surface[row, col]
                slab_top = canopy_top[row, col]
                if slab_top > 0:
                    z_floor = ground[row, col]
                    z_top = z_floor + HEIGHT_STEP_M * slab_top
                    z_bottom = z_floor + HEIGHT_STEP_M * canopy_bottom[row, col]
                    chance = 1.0 - np.exp(-DENSITY_STEP_PER_M * canopy_density[row, col] * (leave - entry))
                    middle = 0.5 * (entry + leave)
                    for b in range(lowest, beams):
                        z = sensor_z + middle * slope[b]
                        if z >= z_top:
                            break
                        if done[b] or z < z_bottom or z <= top:
                            continue
                        if _uniform(seed, a, b, row * cols + col) < chance:
                            done[b] = True
                            along = _uniform(seed + np.uint32(1), a, b, row * cols + col)
                            distance[a, b] = entry + along * (leave - entry)
                            kind[a, b] = _FOLIAGE
                while lowest < beams:
                    if done[lowest]:
                        lowest += 1
                        continue
                    z_in = sensor_z + entry * slope[lowest]
                    if z_in <= top:
                        hit = entry
                    elif sensor_z + leave * slope[lowest] <= top:
                        hit = (top - sensor_z) / slope[lowest]
                    else:
                        break
                    what = material[row, col]
                    if what == _BUILDING and glass_share > 0.0:
                        patch = _uniform(np.uint32(77), row // 5, col // 5, int(np.floor(0.8 * z_in + 1000.0)))
                        if patch < glass_share:
                            hit = 0.0
                    distance[a, lowest] = hit
                    kind[a, lowest] = what
                    lowest += 1
            entry = leave
            if next_row < next_col:
                row += step_row
                next_row += per_row
            else:
                col += step_col
                next_col += per_col
            if row < 0 or col < 0 or row >= rows or col >= cols:
                break
    return distance, kind
