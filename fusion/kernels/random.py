"""Counter-based random numbers: a pure function of a key and a counter, so that work can be done in any order.

Under the filter's key the counter (p, s, stream, 0) gives the numbers of the p-th pair of particles at step s, whatever
thread it falls to. The generator is Threefry-4x32 with 13 rounds, which the authors found to pass BigCrush with 12; its
known answers are tested. 128 bits give six normals by the method of Box and Muller: three radii of 24 bits, so that
normals reach 5.8 standard deviations, and three directions of 18 bits.

Source: Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011.
"""

from typing import Any

import numba
import numpy as np
from numba import types

from fusion.kernels.float_math import INLINED, F, bits_of, float_of, half_circle, intrinsic, log

U = np.uint32
_PARITY = U(0x1BD11BDA)


@intrinsic
def rotated(_context: Any, word: Any, by: Any) -> Any:
    """A uint32 rotated to the left."""

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        kind = context.get_value_type(types.uint32)
        left = builder.trunc(arguments[1], kind) if arguments[1].type.width > 32 else arguments[1]
        return builder.or_(builder.shl(arguments[0], left), builder.lshr(arguments[0], builder.sub(kind(32), left)))

    return types.uint32(word, by), generate


@numba.njit(**INLINED)
def _mix(a: U, b: U, by: int) -> tuple[U, U]:
    a = U(a + b)
    return a, U(rotated(b, by) ^ a)


@numba.njit(**INLINED)
def threefry(
    counter: tuple[U, U, U, U],
    key: tuple[U, U, U, U],
) -> tuple[U, U, U, U]:
    """Four words (uint32) of a counter and a key of four words each: Threefry-4x32, 13 rounds."""
    k0, k1, k2, k3 = key
    k4 = U(_PARITY ^ k0 ^ k1 ^ k2 ^ k3)
    a, b, c, d = U(counter[0] + k0), U(counter[1] + k1), U(counter[2] + k2), U(counter[3] + k3)
    a, b = _mix(a, b, 10)
    c, d = _mix(c, d, 26)
    a, d = _mix(a, d, 11)
    c, b = _mix(c, b, 21)
    a, b = _mix(a, b, 13)
    c, d = _mix(c, d, 27)
    a, d = _mix(a, d, 23)
    c, b = _mix(c, b, 5)
    a, b, c, d = U(a + k1), U(b + k2), U(c + k3), U(d + k4 + U(1))
    a, b = _mix(a, b, 6)
    c, d = _mix(c, d, 20)
    a, d = _mix(a, d, 17)
    c, b = _mix(c, b, 11)
    a, b = _mix(a, b, 25)
    c, d = _mix(c, d, 10)
    a, d = _mix(a, d, 18)
    c, b = _mix(c, b, 20)
    a, b, c, d = U(a + k2), U(b + k3), U(c + k4), U(d + k0 + U(2))
    a, b = _mix(a, b, 10)
    c, d = _mix(c, d, 26)
    a, d = _mix(a, d, 11)
    c, b = _mix(c, b, 21)
    a, b = _mix(a, b, 13)
    c, d = _mix(c, d, 27)
    a, d = _mix(a, d, 23)
    c, b = _mix(c, b, 5)
    a, b, c, d = U(a + k3), U(b + k4), U(c + k0), U(d + k1 + U(3))
    a, b = _mix(a, b, 6)
    c, d = _mix(c, d, 20)
    return a, b, c, d


@numba.njit(**INLINED)
def normal_pair(word: U, more: U) -> tuple[np.float32, np.float32]:
    """Two independent standard normals of a word and the low 10 bits of another."""
    u = (F(np.int32(word >> U(8))) + F(0.5)) * F(2.0**-24)
    radius = np.sqrt(F(-2.0) * log(u))
    direction = np.int32(U(U(U(word & U(0xFF)) << U(10)) | U(more & U(0x3FF))))  # 18 bits
    fraction = np.int32(direction & np.int32(0x1FFFF))
    sine, cosine = half_circle((F(fraction) - F(65535.5)) * F(np.pi / 131072.0))  # (-pi/2, pi/2)
    sign = np.int32(np.int32(direction >> np.int32(17)) << np.int32(31))  # the other half of the circle
    radius = float_of(np.int32(bits_of(radius) ^ sign))
    return radius * cosine, radius * sine
