"""Elementary functions in float32 without a branch, for the insides of loops: numba code that a compiler vectorises.

The library's own ``log``, ``exp`` and ``sin`` are calls, and a call keeps a loop scalar. These are a reduction of the
argument and a minimax polynomial, in 32-bit arithmetic throughout. Largest errors, to which the tests hold them:
`log` 5e-7 absolute plus 1.2e-7 relative, `exp` 1e-6 relative on [-87, 88], `sine_cosine` 4e-7 absolute on [-pi, pi].

Source of the reductions: Cody, Waite, "Software manual for the elementary functions", 1980. The coefficients are
minimax fits by Lawson's algorithm.
"""

from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import extending, types

INLINED: dict[str, Any] = {"fastmath": True, "forceinline": True, "nogil": True, "error_model": "numpy"}
"""Options of functions that compiled code calls: they disappear into it.

One that stayed a function of its own would be optimised once for itself and once more within its caller, to other
roundings, and which of the two is run depends on what the process has loaded: the first run, which compiles, would give
other numbers than the next.
"""
KERNEL: dict[str, Any] = {"fastmath": True, "nogil": True, "error_model": "numpy", "cache": True}
"""Options of functions that Python calls."""

intrinsic: Any = extending.intrinsic
"""As untyped as what it makes: a function of the compiled side, whose first argument the caller does not give."""

F = np.float32
COPIES = 8
"""How many elements `put_copies` writes."""
MOST_TURNS = 31
"""How far from zero `within_a_turn` takes an angle."""
LEAST_EXPONENT, GREATEST_EXPONENT = F(-87.0), F(88.0)
_HALF, _ONE, _TWO = F(0.5), F(1.0), F(2.0)
_SQRT_HALF_BITS, _MANTISSA_BITS, _EXPONENT_BIAS = np.int32(0x3F3504F3), np.int32(23), np.int32(127)
_LOG2_E, _LN_2 = F(1.44269504), F(0.69314718)


@intrinsic
def widest(_context: Any) -> Any:
    """Have the loops of the calling function use the widest registers there are: LLVM keeps to half of AVX-512's."""

    def generate(context: Any, builder: Any, _signature: Any, _arguments: Any) -> Any:
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')  # llvmlite's own `add` knows no widths
        return context.get_dummy_value()

    return types.void(), generate


@intrinsic
def bits_of(_context: Any, value: Any) -> Any:
    """The int32 with the bits of a float32."""

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], context.get_value_type(types.int32))

    return types.int32(value), generate


@intrinsic
def float_of(_context: Any, bits: Any) -> Any:
    """The float32 with the bits of an int32."""

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], context.get_value_type(types.float32))

    return types.float32(bits), generate


def _apart(builder: Any, instruction: Any, kind: str) -> Any:
    """Mark a load or store as one of memory of its own kind: LLVM's type-based alias analysis keeps kinds apart."""
    module, offset = builder.module, ir.Constant(ir.IntType(64), 0)
    root = module.add_metadata([ir.MetaDataString(module, "fusion.kernels")])
    named = module.add_metadata([ir.MetaDataString(module, kind), root, offset])
    instruction.set_metadata("tbaa", module.add_metadata([named, named, offset]))
    return instruction


@intrinsic
def take(_context: Any, array: Any, index: Any) -> Any:
    """``array[index]`` of a contiguous array by an int32 that is known to be inside it: a vector gather.

    LLVM is told that `put` never writes to it, which is for the caller to see to.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        wide = builder.sext(arguments[1], ir.IntType(64))
        return _apart(builder, builder.load(builder.gep(data, [wide], inbounds=True)), "taken")

    return array.dtype(array, index), generate


@intrinsic
def near(_context: Any, array: Any, index: Any) -> Any:
    """As `take`, by an int64: in a loop along neighbours a load of several at once, not a gather."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return _apart(builder, builder.load(builder.gep(data, [arguments[1]], inbounds=True)), "taken")

    return array.dtype(array, types.int64), generate


@intrinsic
def get(_context: Any, scratch: Any, index: Any) -> Any:
    """``scratch[index]``, the index known to be inside it; never of the same memory as what `take` reads."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return _apart(builder, builder.load(builder.gep(data, [arguments[1]], inbounds=True)), "scratch")

    return scratch.dtype(scratch, types.int64), generate


@intrinsic
def put(_context: Any, scratch: Any, index: Any, value: Any) -> Any:
    """``scratch[index] = value``, the index known to be inside it; never of the same memory as what `take` reads."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        address = builder.gep(data, [arguments[1]], inbounds=True)
        _apart(builder, builder.store(arguments[2], address), "scratch")
        return context.get_dummy_value()

    return types.void(scratch, types.int64, scratch.dtype), generate


@intrinsic
def put_copies(_context: Any, array: Any, index: Any, value: Any) -> Any:
    """``array[index : index + COPIES] = value`` in one store, the indices known to be inside it."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        one = arguments[2].type
        many, lane = ir.VectorType(one, COPIES), ir.IntType(32)
        first = builder.insert_element(ir.Constant(many, ir.Undefined), arguments[2], lane(0))
        mask = ir.Constant(ir.VectorType(lane, COPIES), [0] * COPIES)
        spread = builder.shuffle_vector(first, ir.Constant(many, ir.Undefined), mask)
        address = builder.bitcast(builder.gep(data, [arguments[1]], inbounds=True), many.as_pointer())
        builder.store(spread, address, align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, array.dtype), generate


@intrinsic
def larger(_context: Any, a: Any, b: Any) -> Any:
    """The larger of two float32, neither of them NaN, in the form that a vectorised reduction needs."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        is_larger = builder.fcmp_ordered(">", arguments[0], arguments[1], flags=("fast",))
        return builder.select(is_larger, arguments[0], arguments[1], flags=("fast",))

    return types.float32(types.float32, types.float32), generate


@numba.njit(**INLINED)
def log(x: np.float32) -> np.float32:
    """Natural logarithm of a positive, normal float32."""
    bits = bits_of(x)
    exponent = np.int32(np.int32(bits - _SQRT_HALF_BITS) >> _MANTISSA_BITS)
    m = float_of(np.int32(bits - np.int32(exponent << _MANTISSA_BITS))) - _ONE  # in [sqrt(1/2) - 1, sqrt(2) - 1]
    p = F(0.08959917)
    p = p * m + F(-0.14482193)
    p = p * m + F(0.14917379)
    p = p * m + F(-0.16543737)
    p = p * m + F(0.19958417)
    p = p * m + F(-0.25002946)
    p = p * m + F(0.3333416)
    p = p * m + F(-0.49999978)
    return F(exponent) * _LN_2 + (m + m * m * p)


@numba.njit(**INLINED)
def exp(x: np.float32) -> np.float32:
    """Exponential function; the argument is cut to [-87, 88], where float32 has normal numbers."""
    scaled = min(max(x, LEAST_EXPONENT), GREATEST_EXPONENT) * _LOG2_E
    whole = np.int32(scaled + F(127.5))  # the exponent with its bias, rounded: never negative
    f = scaled - F(np.int32(whole - _EXPONENT_BIAS))
    p = F(0.00132765)
    p = p * f + F(0.00967554)
    p = p * f + F(0.05550713)
    p = p * f + F(0.2402212)
    p = p * f + F(0.69314697)
    p = p * f + _ONE
    return p * float_of(np.int32(whole << _MANTISSA_BITS))


@numba.njit(**INLINED)
def _half_circle_sine(x: np.float32) -> np.float32:
    z = x * x
    p = F(2.60522492e-06)
    p = p * z + F(-1.98090753e-04)
    p = p * z + F(8.33305106e-03)
    p = p * z + F(-1.66666580e-01)
    return x + x * z * p


@numba.njit(**INLINED)
def _half_circle_cosine(x: np.float32) -> np.float32:
    z = x * x
    p = F(2.31539316e-05)
    p = p * z + F(-1.38537043e-03)
    p = p * z + F(4.16635847e-02)
    p = p * z + F(-4.99999053e-01)
    return p * z + _ONE


@numba.njit(**INLINED)
def sine_cosine(angle: np.float32) -> tuple[np.float32, np.float32]:
    """Sine and cosine of an angle in [-pi, pi], by those of half of it."""
    half = _HALF * angle
    sine, cosine = _half_circle_sine(half), _half_circle_cosine(half)
    return _TWO * sine * cosine, _ONE - _TWO * sine * sine


@numba.njit(**INLINED)
def half_circle(angle: np.float32) -> tuple[np.float32, np.float32]:
    """Sine and cosine of an angle in [-pi/2, pi/2]."""
    return _half_circle_sine(angle), _half_circle_cosine(angle)


@numba.njit(**INLINED)
def wrap(angle: np.float32) -> np.float32:
    """An angle in (-3 pi, 3 pi) wrapped to [-pi, pi), to float32's rounding."""
    angle = angle - (F(6.2831855) if angle >= F(3.1415925) else F(0.0))
    return angle + (F(6.2831855) if angle < F(-3.1415927) else F(0.0))


@numba.njit(**INLINED)
def within_a_turn(angle: np.float32) -> np.float32:
    """An angle of at most `MOST_TURNS` turns less whole turns: in [-pi, pi], to float32's rounding of it as it came.

    What lies there already comes back as it is.
    """
    turns = np.int32(angle * F(0.15915494) + F(MOST_TURNS + 0.5)) - np.int32(MOST_TURNS)  # rounded: never negative
    return angle - F(turns) * F(6.2831855)
