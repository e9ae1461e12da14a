"""The convolutional encoder-decoder that the voting networks share: a small U-Net (Ronneberger et al., MICCAI 2015).

Its blocks keep strides centred (even kernels), so that turning the image by a quarter turns the grid of features with
it; what the features are worth under a turn is for training to learn.
"""

from __future__ import annotations

from itertools import pairwise

from torch import Tensor, nn

from fusion.errors import SkyfixError

STEM_STRIDE = 2
GROUPS = 4
"""Groups of channels that are normalised together."""


class ConvBlock(nn.Sequential):
    """Convolution, group normalisation, ReLU. Even kernels keep a stride of 2 centred, so turning commutes with it."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride=stride, padding=(kernel - stride + 1) // 2, bias=False),
            nn.GroupNorm(GROUPS, outputs),
            nn.ReLU(inplace=True),
        )


class Pyramid(nn.Module):
    """An encoder of strides 2, 4, 8, ... and a decoder back up to the level `finest`.

    Parameters
    ----------
    inputs
        Channels of the image.
    widths
        Channels of each level, a multiple of 4 each; level k has stride 2^(k + 1).
    finest
        Level at which the decoder ends; 0 is stride 2.
    """

    def __init__(self, inputs: int, widths: tuple[int, ...], finest: int = 0) -> None:
        super().__init__()
        if any(width < GROUPS or width % GROUPS for width in widths):
            raise SkyfixError(f"network widths: expected multiples of {GROUPS}, got {widths}")
        stem = ConvBlock(inputs, widths[0], kernel=6, stride=STEM_STRIDE)
        self.stem = nn.Sequential(stem, ConvBlock(widths[0], widths[0]))
        pairs = list(pairwise(widths))
        self.down = nn.ModuleList(
            [nn.Sequential(ConvBlock(a, b, kernel=4, stride=2), ConvBlock(b, b)) for a, b in pairs]
        )
        self.lateral = nn.ModuleList([nn.Conv2d(b, a, 1) for a, b in pairs[finest:]])
        self.up = nn.ModuleList([ConvBlock(a, a) for a, _ in pairs[finest:]])

    def encode(self, image: Tensor) -> list[Tensor]:
        """Encoded features (B, widths[k], H / 2^(k + 1), W / 2^(k + 1)) of all levels k, the finest first."""
        encoded = [self.stem(image)]
        for down in self.down:
            encoded.append(down(encoded[-1]))
        return encoded

    def decode(self, encoded: list[Tensor]) -> list[Tensor]:
        """Decoded features of the levels from `finest` on, the finest first; the last is the last encoded."""
        x, *skips = encoded[::-1]
        decoded = [x]
        for lateral, up, skip in zip(reversed(self.lateral), reversed(self.up), skips, strict=False):
            coarse = nn.functional.interpolate(lateral(x), size=skip.shape[-2:], mode="bilinear", align_corners=False)
            x = up(skip + coarse)
            decoded.append(x)
        return decoded[::-1]

    def levels(self, image: Tensor) -> list[Tensor]:
        """Decoded features of an image (B, inputs, H, W)."""
        return self.decode(self.encode(image))


class FeatureNet(Pyramid):
    """A small U-Net: (B, inputs, H, W) -> (B, outputs, H / 2, W / 2), receptive field about the whole image."""

    def __init__(self, inputs: int, outputs: int, widths: tuple[int, ...]) -> None:
        super().__init__(inputs, widths)
        self.head = nn.Conv2d(widths[0], outputs, 1)

    def forward(self, image: Tensor) -> Tensor:
        """Features at half the resolution of the image."""
        return self.head(self.levels(image)[0])


class LevelHead(nn.Module):
    """Levels of features, the finest first -> channels at the finest: it projected, the others too if asked."""

    def __init__(self, widths: tuple[int, ...], outputs: int, multi_scale: bool) -> None:
        super().__init__()
        self.finest = nn.Conv2d(widths[0], outputs, 1)
        coarser = widths[1:] if multi_scale else ()
        self.coarser = nn.ModuleList([nn.Conv2d(width, outputs, 1, bias=False) for width in coarser])

    def forward(self, levels: list[Tensor]) -> Tensor:
        """(B, outputs, H, W) of the finest level; a sum of projections is the projection of the concatenated levels."""
        x = self.finest(levels[0])
        size = x.shape[-2:]
        for project, level in zip(self.coarser, levels[1:], strict=False):
            x = x + nn.functional.interpolate(project(level), size=size, mode="bilinear", align_corners=False)
        return x
