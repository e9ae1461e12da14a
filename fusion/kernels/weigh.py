"""Weighing a block of particles: the log density of a likelihood on a grid, between its cells, with outliers."""

import numba
import numpy as np

from fusion.kernels.float_math import INLINED, F, exp, get, larger, log, put, take, widest
from fusion.kernels.layout import (
    ADDED,
    BIN_STRIDE,
    BINS,
    COLS,
    FLOOR,
    INLIER,
    PIXEL_STRIDE,
    ROWS,
    TEMPER_SCALE,
    TEMPER_SHIFT,
    UNIFORM,
    Float32s,
    Float64s,
    Int32s,
    T,
    X,
    Y,
)


@numba.njit(**INLINED)
def _cell(position: F, count: np.int32) -> tuple[np.int32, np.int32, F]:
    """Lower cell, step to the upper one and weight of the upper one, of a position in cells from the edge."""
    last = F(count) - F(1.0)
    inner = larger(position - F(0.5), F(0.0))
    inner = min(last, inner)
    highest = np.int32(count - 2) if count > 2 else np.int32(0)
    lower = np.int32(inner)
    lower = min(highest, lower)
    return lower, np.int32(1) if count > 1 else np.int32(0), inner - F(lower)


@numba.njit(**INLINED)
def _bin(yaw: F, scale: F, bins: np.int32) -> tuple[np.int32, np.int32, F]:
    """Lower bin, upper bin and weight of the upper one, of a heading in [-pi, pi)."""
    turns = yaw * scale
    turns = turns + F(bins) if turns < F(0.0) else turns
    lower = np.int32(turns)
    lower = lower if lower < bins else np.int32(bins - 1)
    upper = np.int32(lower + 1)
    return lower, upper if upper < bins else np.int32(0), turns - F(lower)


@numba.njit(**INLINED)
def _level(value: np.float32, scale: np.float32, shift: np.float32, before: np.float32, floor: np.float32) -> F:
    """A cell's ln density after tempering, which leaves alone what was not evaluated."""
    return scale * value + shift if value > before else floor


@numba.njit(**INLINED)
def _mix_outliers(n: int, inlier: np.float32, uniform: np.float32, s: Float32s) -> None:
    """Mix the uniform density into ln densities: a loop of its own, so that more particles are under way at once."""
    for j in range(n):
        s[ADDED + j] = log(inlier * exp(s[ADDED + j]) + uniform)


@numba.njit(**INLINED)
def weigh_by_volume(n: int, table: Float32s, look: Float64s, s: Float32s) -> None:
    """ln density of a block under a volume that has the headings of a cell side by side."""
    widest()
    rows, cols, bins = np.int32(look[ROWS]), np.int32(look[COLS]), np.int32(look[BINS])
    cs, c0, rs, r0, ks = F(look[0]), F(look[1]), F(look[2]), F(look[3]), F(look[4])
    scale, shift, before, floor = F(look[5]), F(look[6]), F(look[7]), F(look[8])
    inlier, uniform = F(look[9]), F(look[10])
    row_stride = np.int32(cols * bins)
    for j in range(n):
        u, v = c0 + cs * get(s, X + j), r0 + rs * get(s, Y + j)
        col, east, cw = _cell(u, cols)
        row, south, rw = _cell(v, rows)
        k, upper, kw = _bin(get(s, T + j), ks, bins)
        a = np.int32(np.int32(row * row_stride) + np.int32(col * bins))
        b = np.int32(a + np.int32(east * bins))
        down = np.int32(south * row_stride)
        c, d = np.int32(a + down), np.int32(b + down)
        low = _level(take(table, np.int32(a + k)), scale, shift, before, floor)
        high = _level(take(table, np.int32(a + upper)), scale, shift, before, floor)
        nw = low + kw * (high - low)
        low = _level(take(table, np.int32(b + k)), scale, shift, before, floor)
        high = _level(take(table, np.int32(b + upper)), scale, shift, before, floor)
        ne = low + kw * (high - low)
        low = _level(take(table, np.int32(c + k)), scale, shift, before, floor)
        high = _level(take(table, np.int32(c + upper)), scale, shift, before, floor)
        sw = low + kw * (high - low)
        low = _level(take(table, np.int32(d + k)), scale, shift, before, floor)
        high = _level(take(table, np.int32(d + upper)), scale, shift, before, floor)
        se = low + kw * (high - low)
        north, far = nw + cw * (ne - nw), sw + cw * (se - sw)
        total = larger(north + rw * (far - north), floor)
        inside = (u >= F(0.0)) & (u <= F(cols)) & (v >= F(0.0)) & (v <= F(rows))
        put(s, ADDED + j, total if inside else floor)
    _mix_outliers(n, inlier, uniform, s)


@numba.njit(**INLINED)
def _pixel_level(
    pixel: np.int32, lower: np.int32, upper: np.int32, kw: F, table: Float32s, location: Float32s, terms: tuple[F, F, F]
) -> F:
    """ln density at a pixel between two headings of it."""
    scale, shift, floor = terms
    at = take(location, pixel)
    low = larger(scale * (at + take(table, lower)) + shift, floor)
    high = larger(scale * (at + take(table, upper)) + shift, floor)
    return low + kw * (high - low)


@numba.njit(**INLINED)
def weigh_by_maps(
    n: int,
    table: Float32s,
    location: Float32s,
    slots: Int32s,
    look: Float64s,
    s: Float32s,
) -> None:
    """ln density of a block under a map of positions and, at every pixel, a distribution of headings."""
    widest()
    rows, cols, bins = np.int32(look[ROWS]), np.int32(look[COLS]), np.int32(look[BINS])
    pixel_stride, bin_stride = np.int32(look[PIXEL_STRIDE]), np.int32(look[BIN_STRIDE])
    cs, c0, rs, r0, ks = F(look[0]), F(look[1]), F(look[2]), F(look[3]), F(look[4])
    floor, inlier, uniform = F(look[FLOOR]), F(look[INLIER]), F(look[UNIFORM])
    terms = (F(look[TEMPER_SCALE]), F(look[TEMPER_SHIFT]), floor)
    for j in range(n):
        u, v = c0 + cs * get(s, X + j), r0 + rs * get(s, Y + j)
        col, east, cw = _cell(u, cols)
        row, south, rw = _cell(v, rows)
        k, upper, kw = _bin(get(s, T + j), ks, bins)
        k, upper = np.int32(k * bin_stride), np.int32(upper * bin_stride)
        a = np.int32(np.int32(row * cols) + col)
        b, c = np.int32(a + east), np.int32(a + np.int32(south * cols))
        d = np.int32(c + east)
        at_a, at_b = np.int32(take(slots, a) * pixel_stride), np.int32(take(slots, b) * pixel_stride)
        at_c, at_d = np.int32(take(slots, c) * pixel_stride), np.int32(take(slots, d) * pixel_stride)
        nw = _pixel_level(a, np.int32(at_a + k), np.int32(at_a + upper), kw, table, location, terms)
        ne = _pixel_level(b, np.int32(at_b + k), np.int32(at_b + upper), kw, table, location, terms)
        sw = _pixel_level(c, np.int32(at_c + k), np.int32(at_c + upper), kw, table, location, terms)
        se = _pixel_level(d, np.int32(at_d + k), np.int32(at_d + upper), kw, table, location, terms)
        north, far = nw + cw * (ne - nw), sw + cw * (se - sw)
        total = north + rw * (far - north)
        inside = (u >= F(0.0)) & (u <= F(cols)) & (v >= F(0.0)) & (v <= F(rows))
        put(s, ADDED + j, total if inside else floor)
    _mix_outliers(n, inlier, uniform, s)
