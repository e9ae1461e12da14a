"""Attention: of a feature map to its own channels and places, and of map and scan to each other.

CBAM is Woo et al., ECCV 2018, equations 1-3. Cross-attention is TransLocNet's (arXiv 2512.10419): both ways, four
heads, with a learnable bias for every offset between a query's cell and a key's (Swin, Liu et al., ICCV 2021,
equation 4). The bias means something only where both grids have the same axes and scale, so the scan must have been
turned to the prior heading before it is encoded.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn


class ChannelSpatialAttention(nn.Module):
    """CBAM: weigh channels by what they hold anywhere, then places by what the channels hold there."""

    def __init__(self, channels: int, reduction: int = 16, kernel: int = 7) -> None:
        super().__init__()
        hidden = max(4, channels // reduction)  # of fewer, all may be dead
        self.channel = nn.Sequential(
            nn.Linear(channels, hidden, bias=False), nn.ReLU(inplace=True), nn.Linear(hidden, channels, bias=False)
        )
        self.spatial = nn.Conv2d(2, 1, kernel, padding=kernel // 2, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) -> the same shape, every value scaled by two factors in (0, 1)."""
        scores = self.channel(x.mean(dim=(2, 3))) + self.channel(x.amax(dim=(2, 3)))
        x = x * torch.sigmoid(scores)[:, :, None, None]
        summary = torch.cat([x.mean(dim=1, keepdim=True), x.amax(dim=1, keepdim=True)], dim=1)
        return x * torch.sigmoid(self.spatial(summary))


class RelativePositionBias(nn.Module):
    """A learnable number for each head and each offset (rows, columns) from a key's cell to a query's."""

    def __init__(self, heads: int, side: int) -> None:
        super().__init__()
        self.table = nn.Parameter(torch.zeros(heads, 2 * side - 1, 2 * side - 1))
        nn.init.trunc_normal_(self.table, std=0.02)
        cell = torch.arange(side * side)
        row, col = cell // side, cell % side
        self.row: Tensor
        self.col: Tensor
        self.register_buffer("row", row[:, None] - row[None, :] + side - 1, persistent=False)
        self.register_buffer("col", col[:, None] - col[None, :] + side - 1, persistent=False)

    def forward(self) -> Tensor:
        """(heads, queries, keys) on a square grid, cells counted row by row."""
        return self.table[:, self.row, self.col]


class CrossAttention(nn.Module):
    """Queries of one grid read from the other grid; then a feed-forward layer. Normalised before, added after."""

    def __init__(self, channels: int, heads: int, side: int, expansion: int = 4) -> None:
        super().__init__()
        self.heads = heads
        self.query_norm, self.key_norm, self.output_norm = (nn.LayerNorm(channels) for _ in range(3))
        self.query, self.value, self.output = (nn.Linear(channels, channels) for _ in range(3))
        self.key = nn.Linear(channels, channels, bias=False)  # softmax would not see one: it adds the same to every key
        self.bias = RelativePositionBias(heads, side)
        self.feed_forward = nn.Sequential(
            nn.Linear(channels, expansion * channels), nn.GELU(), nn.Linear(expansion * channels, channels)
        )

    def forward(self, queries: Tensor, keys: Tensor) -> Tensor:
        """(B, N, C) tokens of both grids -> (B, N, C) on the grid of the queries."""
        source = self.key_norm(keys)
        q, k, v = (
            layer(tokens).unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for layer, tokens in ((self.query, self.query_norm(queries)), (self.key, source), (self.value, source))
        )
        scores = q @ k.transpose(-1, -2) * q.shape[-1] ** -0.5 + self.bias()
        read = (scores.softmax(dim=-1) @ v).transpose(1, 2).flatten(2)
        queries = queries + self.output(read)
        return queries + self.feed_forward(self.output_norm(queries))


class BidirectionalCrossAttention(nn.Module):
    """Map reads from scan (on the map's grid) and scan reads from map (on the vehicle's grid)."""

    def __init__(self, channels: int, heads: int, side: int) -> None:
        super().__init__()
        self.map_from_scan = CrossAttention(channels, heads, side)
        self.scan_from_map = CrossAttention(channels, heads, side)

    def forward(self, map_features: Tensor, scan_features: Tensor) -> tuple[Tensor, Tensor]:
        """Two (B, C, side, side) -> the paper's a2b on the map's grid and b2a on the vehicle's, of the same shape."""
        shape = map_features.shape[-2:]
        map_tokens, scan_tokens = (x.flatten(2).transpose(1, 2) for x in (map_features, scan_features))
        a2b = self.map_from_scan(map_tokens, scan_tokens)
        b2a = self.scan_from_map(scan_tokens, map_tokens)
        return a2b.transpose(1, 2).unflatten(2, shape), b2a.transpose(1, 2).unflatten(2, shape)
