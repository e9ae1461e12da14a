"""Array types, and the check that every public function applies to the arrays it is given."""

from collections.abc import Iterable, Sequence
from types import EllipsisType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion.errors import SkyfixError

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

Shape = Sequence[int | str | EllipsisType]


def _shape_matches(shape: tuple[int, ...], expected: Shape) -> bool:
    if expected and expected[0] is ...:
        expected = expected[1:]
        shape = shape[max(0, len(shape) - len(expected)) :]
    return len(shape) == len(expected) and all(
        not isinstance(want, int) or have == want for have, want in zip(shape, expected, strict=True)
    )


def _shape_text(expected: Shape) -> str:
    words = ["..." if size is ... else str(size) for size in expected]
    return f"({words[0]},)" if len(words) == 1 else f"({', '.join(words)})"


def checked(name: str, value: ArrayLike, shape: Shape) -> FloatArray:
    """Return `value` as a float64 array after checking its shape and that every entry is finite.

    Parameters
    ----------
    name : str
        What the array is; the message begins with it.
    value : array_like
        The caller's data. It is not copied when it is float64 already.
    shape : sequence of int, str or Ellipsis
        Expected shape; a string such as ``"N"`` matches any size, a leading ``...`` any number of axes.

    Raises
    ------
    SkyfixError
        When `value` is not numeric, has another shape, or holds NaN or an infinity.
    """
    try:
        given = np.asarray(value)
        if given.dtype.kind not in "biufO":
            raise TypeError(given.dtype)
        array = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SkyfixError(f"{name}: expected {_shape_text(shape)} numbers, got {type(value).__name__}") from error
    if not _shape_matches(array.shape, shape):
        raise SkyfixError(f"{name}: expected {_shape_text(shape)}, got {array.shape}")
    if not np.isfinite(array).all():
        bad = int(np.count_nonzero(~np.isfinite(array)))
        raise SkyfixError(f"{name}: expected finite values, got {bad} of {array.size} not finite")
    return array


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Return a view of `array` that cannot be written through, for the fields of frozen dataclasses."""
    view = array.view()
    view.flags.writeable = False
    return view


def keep_plain(settings: Any, names: Iterable[str]) -> None:
    """Put Python's own numbers in place of numpy's in fields of a frozen dataclass, exactly.

    A float32 would go on to round what it is multiplied by, and come back from a file as a float that does not.
    """
    for name in names:
        value = getattr(settings, name)
        if isinstance(value, np.generic):
            object.__setattr__(settings, name, value.item())
