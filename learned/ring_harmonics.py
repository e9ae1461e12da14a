"""Ring harmonics: what lies around a place, ring by ring, as Fourier coefficients over the bearing.

For a feature image f about a place, z(c, r, m) = sum over cells of f_c w_r(distance) exp(-i m bearing). To turn the
image by an angle a multiplies order m by exp(-i m a), so that two places are compared at all headings at once,

    score(a) = Re sum_m k_m exp(i m a) sum_(c, r) conj(scan(c, r, m)) map(c, r, m)      k_0 = 1, else 2,

which is a vote (`learned.voting`) blurred to the width of the rings and of the highest order. The magnitudes alone are
the rotation-invariant place descriptors of the literature; they forget how the rings lie to each other, and this does
not. Source: Xu et al., "DiSCO: differentiable scan context with orientation", RA-L 2021, for spectra over the bearing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from fusion.arrays import Float32Array
from fusion.errors import SkyfixError

_DEFAULT_RINGS_M = (4.0, 10.0, 16.0, 22.0, 28.0, 34.0, 40.0, 48.0, 56.0, 64.0)


@dataclass(frozen=True, slots=True)
class RingHarmonics:
    """Which rings and orders.

    Attributes
    ----------
    rings_m
        Radii at which the rings' triangular windows peak, rising; the first window is flat inside.
    orders
        M: orders 0 .. M are kept.
    cell_m
        Cells of the images.
    reach_m
        Half the side of the images.
    """

    rings_m: tuple[float, ...] = _DEFAULT_RINGS_M
    orders: int = 16
    cell_m: float = 4.0
    reach_m: float = 72.0

    def __post_init__(self) -> None:
        rings = np.array(self.rings_m)
        if len(rings) < 2 or rings[0] <= 0.0 or (np.diff(rings) <= 0.0).any() or rings[-1] > self.reach_m:
            raise SkyfixError(f"rings: expected rising radii up to {self.reach_m:g} m, got {self.rings_m}")
        if self.orders < 1 or self.cell_m <= 0.0 or self.size % 2:
            raise SkyfixError(f"rings: expected orders >= 1 and an even number of cells, got {self}")

    @property
    def size(self) -> int:
        """Cells on a side of the images."""
        return round(2.0 * self.reach_m / self.cell_m)

    def basis(self) -> Tensor:
        """Real and imaginary parts side by side, (size^2, 2 * rings * (M + 1)) float32."""
        offset = (np.arange(self.size) + 0.5 - self.size / 2) * self.cell_m
        x, y = np.meshgrid(offset, -offset)
        bearing = np.arctan2(y, x)
        turned = np.exp(-1j * np.arange(self.orders + 1)[:, None, None] * bearing)
        kernels = self._windows(np.hypot(x, y))[:, None] * turned
        flat = kernels.reshape(-1, self.size**2).T
        return torch.from_numpy(np.concatenate([flat.real, flat.imag], axis=1).astype(np.float32))

    def _windows(self, distance: Float32Array) -> Float32Array:
        """(rings, size, size): each rises from the ring before and falls to the one after."""
        rings = np.array(self.rings_m)
        after = np.append(rings[1:], 2.0 * rings[-1] - rings[-2])
        windows = []
        for number, (peak, outer) in enumerate(zip(rings, after, strict=True)):
            rise = (
                np.ones_like(distance) if number == 0 else (distance - rings[number - 1]) / (peak - rings[number - 1])
            )
            windows.append(np.clip(np.minimum(rise, (outer - distance) / (outer - peak)), 0.0, 1.0))
        return np.stack(windows)

    def of(self, images: Tensor, basis: Tensor) -> Tensor:
        """Harmonics (P, C * rings, M + 1) complex64 of images (P, C, size, size); `basis` as the method gives it.

        Raises
        ------
        SkyfixError
            If the images have another size.
        """
        if images.ndim != 4 or images.shape[2:] != (self.size, self.size):
            raise SkyfixError(f"ring images: expected (P, C, {self.size}, {self.size}), got {tuple(images.shape)}")
        places, channels = images.shape[:2]
        sums = images.reshape(places * channels, -1) @ basis
        real, imaginary = sums.view(places, channels, 2, len(self.rings_m), self.orders + 1).unbind(2)
        return torch.complex(real, imaginary).reshape(places, channels * len(self.rings_m), self.orders + 1)


def at_headings(products: Tensor, headings: int) -> Tensor:
    """Scores (..., headings) at yaws 2 pi k / headings from products (..., M + 1) of two places' harmonics.

    `products` are sums of conj(scan) map, each order's factor k_m included.
    """
    orders = torch.arange(products.shape[-1], dtype=torch.float64)
    yaws = torch.arange(headings, dtype=torch.float64) * (2.0 * math.pi / headings)
    phase = torch.outer(orders, yaws)
    return products.real @ torch.cos(phase).float() - products.imag @ torch.sin(phase).float()
