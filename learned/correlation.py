"""Correlation of templates with a map by real FFTs: one with gradients, and one that spends as little as it can.

Where no gradient is asked for, the map's spectrum is computed once, templates are transformed one at a time (their
spectrum stays in the processor's cache), only the rows that are wanted are transformed back, and a template that is
asked for at headings a quarter turn apart is turned and transformed once: to turn the template is to turn the map the
other way, and the answer back.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from fusion.errors import SkyfixError

_QUICK_FACTORS = (2, 3, 5, 7, 11, 13)
_QUICK_MULTIPLE = 8


def fast_length(least: int) -> int:
    """The first length from `least` on whose FFT is quick: a multiple of 8 with no prime factor above 13."""
    length = -(-least // _QUICK_MULTIPLE) * _QUICK_MULTIPLE
    while not _is_smooth(length):
        length += _QUICK_MULTIPLE
    return length


def _is_smooth(number: int) -> bool:
    for factor in _QUICK_FACTORS:
        while number % factor == 0:
            number //= factor
    return number == 1


def correlate(map_features: Tensor, templates: Tensor) -> Tensor:
    """Correlate templates with the map wherever they lie wholly inside it.

    Parameters
    ----------
    map_features
        (C, H, W).
    templates
        (R, C, h, w) with h <= H and w <= W.

    Returns
    -------
    (R, H - h + 1, W - w + 1): sum over channels and pixels of map[c, r + i, q + j] * template[c, i, j]. No shift
    wraps around: only shifts that keep the template inside are returned, so the map's own size is padding enough.
    """
    _check_sizes(map_features, templates)
    scores: Tensor = _Correlation.apply(map_features, templates)
    return scores


class _Correlation(torch.autograd.Function):
    """Correlation by real FFTs, backwards too (autograd's own backward takes complex ones of full size)."""

    @staticmethod
    def forward(ctx: Any, map_features: Tensor, templates: Tensor) -> Tensor:
        height, width = map_features.shape[-2:]
        padded = fast_length(height), fast_length(width)
        map_spectrum = torch.fft.rfft2(map_features, s=padded)
        spectra = torch.fft.rfft2(templates, s=padded)
        ctx.save_for_backward(map_spectrum, spectra)
        ctx.shapes = padded, (height, width), templates.shape[-2:]
        scores = torch.fft.irfft2((spectra.conj() * map_spectrum).sum(dim=1), s=padded)
        rows, cols = height - templates.shape[-2] + 1, width - templates.shape[-1] + 1
        return scores[:, :rows, :cols].contiguous()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        map_spectrum, spectra = ctx.saved_tensors
        padded, (height, width), (rows, cols) = ctx.shapes
        gradient = torch.fft.rfft2(gradients[0], s=padded)[:, None]
        to_map = torch.fft.irfft2((gradient * spectra).sum(dim=0), s=padded)
        to_templates = torch.fft.irfft2(gradient.conj() * map_spectrum, s=padded)
        return to_map[..., :height, :width], to_templates[..., :rows, :cols]


class MapCorrelator:
    """A map (C, H, W) to be correlated with many square templates, without gradients.

    Parameters
    ----------
    map_features
        (C, H, W).
    side
        Of the transforms, at least that of the map; so that maps of several sizes can share a template's spectrum.
    """

    def __init__(self, map_features: Tensor, side: int | None = None) -> None:
        self._map = map_features
        self._side = side or fast_length(max(map_features.shape[-2:]))
        self._spectra: dict[int, Tensor] = {}

    def scores(self, template: Tensor, quarter_turns: list[int]) -> list[Tensor]:
        """What `correlate` gives of a template (C, n, n), turned counter-clockwise by each number of quarter turns."""
        _check_sizes(self._map, template)
        spectrum = template_spectrum(template, self._side)
        return [self.scores_of(spectrum, template.shape[-1], turns) for turns in quarter_turns]

    def scores_of(self, spectrum: Tensor, size: int, turns: int) -> Tensor:
        """The same for one number of quarter turns, of the `template_spectrum` of a template of `size` cells."""
        turns %= 4
        product = (spectrum * self._conjugate(turns)).sum(dim=0).conj().resolve_conj()
        height, width = self._map.shape[-2:] if turns % 2 == 0 else self._map.shape[:-3:-1]
        wanted_rows = torch.fft.ifft(product, dim=0)[: height - size + 1]
        found = torch.fft.irfft(wanted_rows, n=self._side, dim=1)[:, : width - size + 1]
        return torch.rot90(found, turns)

    def _conjugate(self, turns: int) -> Tensor:
        """Conjugate spectrum (C, side, side / 2 + 1) of the map, turned clockwise by quarter turns."""
        if turns not in self._spectra:
            turned = torch.rot90(self._map, -turns, dims=(1, 2))
            self._spectra[turns] = torch.fft.rfft2(turned, s=(self._side, self._side)).conj().resolve_conj()
        return self._spectra[turns]


def template_spectrum(template: Tensor, side: int) -> Tensor:
    """Spectrum (C, side, side / 2 + 1) of a template (C, n, n)."""
    spectrum: Tensor = torch.fft.rfft2(template, s=(side, side))
    return spectrum


def _check_sizes(map_features: Tensor, templates: Tensor) -> None:
    size, template = tuple(map_features.shape[-2:]), tuple(templates.shape[-2:])
    if template[0] > size[0] or template[1] > size[1]:
        raise SkyfixError(f"voting: expected a template no larger than the map's {size}, got {template}")
