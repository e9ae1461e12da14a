"""Scratch: memory for intermediate results that are as large as the result, kept from one step to the next.

To ask the system for fresh memory at every step costs as much as to fill it twice.
"""

from math import prod

import numpy as np

from fusion.arrays import Float32Array


class Scratch:
    """One block of memory; whoever takes it owns it until it is taken again."""

    def __init__(self) -> None:
        self._block = np.empty(0, dtype=np.float32)

    def take(self, shape: tuple[int, ...]) -> Float32Array:
        """An array of that shape, its values left over from anything; the one given before is no longer valid."""
        size = prod(shape)
        if self._block.size < size:
            self._block = np.empty(size, dtype=np.float32)
        return self._block[:size].reshape(shape)
