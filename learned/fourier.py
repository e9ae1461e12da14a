"""The Fourier branch of TransLocNet (arXiv 2512.10419): how much structure of each wavelength a feature map has.

The magnitude of a spectrum does not change when its image is shifted cyclically; when the image is turned the
spectrum turns with it, so it is not invariant to rotation, which the paper says it is. And it lives on a grid of
frequencies, not of places: it is added beside the spatial features and never instead of them. Averaged over the
frequencies of one wavelength, whatever their direction, it is what the paper wants: the same for every heading.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

FourierMode = Literal["off", "spectrum", "rotation_pooled"]


class FourierBranch(nn.Module):
    """Concatenate log(1 + |FFT|) of the features to them and bring both back to the same number of channels.

    Parameters
    ----------
    channels, side
        The feature map is (channels, side, side).
    pool_rotations
        Replace every magnitude by the mean over the annulus of frequencies that it lies on.
    """

    def __init__(self, channels: int, side: int, pool_rotations: bool) -> None:
        super().__init__()
        self.mix = nn.Conv2d(2 * channels, channels, 1)
        self.pool_rotations = pool_rotations
        self.annulus: Tensor
        self.register_buffer("annulus", annulus_means(side), persistent=False)

    def spectrum(self, features: Tensor) -> Tensor:
        """log(1 + |FFT|), orthonormal, frequency (0, 0) first; (B, C, side, side) on the grid of frequencies."""
        with torch.autocast(features.device.type, enabled=False):
            magnitude = torch.log1p(torch.fft.fft2(features.float(), norm="ortho").abs())
            if self.pool_rotations:
                magnitude = (magnitude.flatten(2) @ self.annulus).unflatten(2, features.shape[-2:])
            return magnitude

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, side, side) -> the same shape."""
        return self.mix(torch.cat([features, self.spectrum(features)], dim=1))


def annulus_means(side: int) -> Tensor:
    """Symmetric matrix (side^2, side^2) that replaces each frequency's value by the mean over its annulus.

    An annulus is one frequency step wide; its frequencies have the same rounded distance from zero.
    """
    frequency = torch.fft.fftfreq(side) * side
    ring = torch.hypot(frequency[:, None], frequency[None, :]).round().flatten()
    same = (ring[:, None] == ring[None, :]).float()
    return same / same.sum(dim=1, keepdim=True)
