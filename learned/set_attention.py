"""Attention of two grids to each other that knows nothing of where on them a token lies.

TransLocNet's cross-attention (arXiv 2512.10419; `learned.attention`) has a bias for every offset between a map cell
and a scan cell, which means something only if the scan was turned to a heading known beforehand. A network that
votes does not know the heading when it attends. So here a token is what its features say and no more: what the map
reads from the scan depends on the set of the scan's tokens, not on their order. Turning the scan's features permutes
its tokens; the map reads the same as before, and what the scan reads turns with it. Exactly so by quarter turns, and
for others as far as the encoder's features turn with their image, which is what voting rests on anyway.

The same holds for shifting the map, but for what enters and leaves its crop: the map's features say what is where on
it, given that the scan was taken somewhere on it.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

_FIRST_GAIN = 0.1
"""What is read starts as a small correction of what is there."""


class SetAttention(nn.Module):
    """Tokens of one set read from another set; then a feed-forward layer. Normalised before, scaled and added after."""

    def __init__(self, channels: int, source_channels: int, heads: int, expansion: int = 2) -> None:
        super().__init__()
        self.heads = heads
        self.token_norm, self.output_norm = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.source_norm = nn.LayerNorm(source_channels)
        self.query, self.output = nn.Linear(channels, channels), nn.Linear(channels, channels)
        # A bias of the keys would shift all scores of a query alike, which a softmax does not see.
        self.key = nn.Linear(source_channels, channels, bias=False)
        self.value = nn.Linear(source_channels, channels)
        self.feed_forward = nn.Sequential(
            nn.Linear(channels, expansion * channels), nn.GELU(), nn.Linear(expansion * channels, channels)
        )
        self.gain = nn.Parameter(torch.full((2, channels), _FIRST_GAIN))

    def forward(self, tokens: Tensor, source: Tensor) -> Tensor:
        """Tokens (B, N, C) after reading from source tokens (B, M, C')."""
        normed = self.source_norm(source)
        q, k, v = (
            layer(given).unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for layer, given in ((self.query, self.token_norm(tokens)), (self.key, normed), (self.value, normed))
        )
        read = nn.functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
        tokens = tokens + self.gain[0] * self.output(read)
        return tokens + self.gain[1] * self.feed_forward(self.output_norm(tokens))


class BidirectionalSetAttention(nn.Module):
    """Map reads from scan, and scan from map; both read what the other was before."""

    def __init__(self, scan_channels: int, map_channels: int, heads: int) -> None:
        super().__init__()
        self.scan_from_map = SetAttention(scan_channels, map_channels, heads)
        self.map_from_scan = SetAttention(map_channels, scan_channels, heads)

    def forward(self, scan: Tensor, found: Tensor) -> tuple[Tensor, Tensor]:
        """Feature images of scan (B, C, n, n) and map (B, C', H, W), of any size, to the same shapes."""
        scan_tokens, map_tokens = (image.flatten(2).transpose(1, 2) for image in (scan, found))
        refined = self.scan_from_map(scan_tokens, map_tokens), self.map_from_scan(map_tokens, scan_tokens)
        read_scan, read_map = (
            tokens.transpose(1, 2).unflatten(2, image.shape[-2:])
            for tokens, image in zip(refined, (scan, found), strict=True)
        )
        return read_scan, read_map


class RingSpectrum(nn.Module):
    """How much structure of each wavelength an image has, whatever its place and direction: (B, C, n, n) -> (B, C).

    log(1 + |FFT|), averaged over rings of frequencies and mixed by a linear layer. The magnitude does not change when
    the image is shifted cyclically, nor its rings when it is turned (TransLocNet's branch without the average turns
    with the image, see `learned.fourier`). Rings are fractions of the sampling frequency, so any size will do.
    """

    def __init__(self, channels: int, outputs: int, rings: int = 6) -> None:
        super().__init__()
        self.rings = rings
        self.mix = nn.Linear(channels * rings, outputs)

    def forward(self, image: Tensor) -> Tensor:
        """One vector an image."""
        with torch.autocast(image.device.type, enabled=False):
            magnitude = torch.log1p(torch.fft.fft2(image.float(), norm="ortho").abs()).flatten(2)
            means = magnitude @ self._rings(image.shape[-2], image.shape[-1]).to(magnitude)
        return self.mix(means.flatten(1))

    def _rings(self, rows: int, cols: int) -> Tensor:
        """(rows * cols, rings): means over the rings; frequencies beyond half the sampling rate are in none."""
        frequency = torch.hypot(torch.fft.fftfreq(rows)[:, None], torch.fft.fftfreq(cols)[None, :]).flatten()
        ring = (frequency * 2 * self.rings).long()
        member = nn.functional.one_hot(ring.clamp(max=self.rings), self.rings + 1)[:, : self.rings].float()
        return member / member.sum(dim=0).clamp(min=1.0)
