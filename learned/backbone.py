"""Residual encoders: ResNet-34 without its classifier, and smaller ones of the same shape.

He et al., "Deep Residual Learning for Image Recognition", CVPR 2016, table 1 (ResNet-34: basic blocks 3, 4, 6, 3).

It is written here and not taken from torchvision, because torchvision is a compiled extension that has to match the
build of torch to the patch; these hundred lines save every user that dependency.

Normalisation is by groups of channels (Wu & He, ECCV 2018), not by batch: on a CPU a batch holds one or a few
samples, of which batch statistics say nothing, and a batch of one has none at the end. It has a scale and a shift a
channel like batch normalisation, so the parameter count is ResNet-34's.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn

from fusion.errors import SkyfixError

CHANNELS_PER_GROUP = 8
"""Channels that are normalised together; every width is a multiple of it."""


@dataclass(frozen=True, slots=True)
class BackboneSettings:
    """Sizes of an encoder.

    Attributes
    ----------
    stem_width, stem_kernel, stem_stride
        First convolution; a pooling by 2 follows it.
    widths, blocks
        Channels of the four stages, and how many basic blocks each has; every stage but the first halves the image.
    """

    stem_width: int = 64
    stem_kernel: int = 7
    stem_stride: int = 2
    widths: tuple[int, int, int, int] = (64, 128, 256, 512)
    blocks: tuple[int, int, int, int] = (3, 4, 6, 3)

    def __post_init__(self) -> None:
        for width in (self.stem_width, *self.widths):
            if width < CHANNELS_PER_GROUP or width % CHANNELS_PER_GROUP:
                raise SkyfixError(f"encoder width: expected a multiple of {CHANNELS_PER_GROUP}, got {width}")
        if self.stem_stride not in (1, 2) or self.stem_kernel % 2 == 0 or min(self.blocks) < 1:
            raise SkyfixError(
                "encoder: expected a stem stride of 1 or 2, an odd kernel and a block a stage, got "
                f"{self.stem_stride}, {self.stem_kernel} and {self.blocks}"
            )


def normalisation(channels: int) -> nn.GroupNorm:
    """Group normalisation of `CHANNELS_PER_GROUP` channels a group, which does not depend on the batch.

    TransLocNet's ResNet-34 has batch normalisation, which needs larger batches than fit a CPU's memory.
    """
    return nn.GroupNorm(channels // CHANNELS_PER_GROUP, channels)


def convolution(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    """Convolution without bias, normalisation, ReLU; an odd kernel keeps the size but for the stride."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False),
        normalisation(outputs),
        nn.ReLU(inplace=True),
    )


class BasicBlock(nn.Module):
    """Two 3 x 3 convolutions around which the input passes, projected where shape changes (figure 5, left)."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.first = convolution(inputs, outputs, 3, stride)
        self.second = nn.Sequential(nn.Conv2d(outputs, outputs, 3, padding=1, bias=False), normalisation(outputs))
        self.shortcut: nn.Module = nn.Identity()
        if stride != 1 or inputs != outputs:
            projection = nn.Conv2d(inputs, outputs, 1, stride, bias=False)
            self.shortcut = nn.Sequential(projection, normalisation(outputs))
        self.relu = nn.ReLU(inplace=True)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, outputs, H / stride, W / stride)."""
        return self.relu(self.second(self.first(x)) + self.shortcut(x))


class ResidualEncoder(nn.Module):
    """Stem and four stages; returns the features of all five."""

    def __init__(self, inputs: int, settings: BackboneSettings) -> None:
        super().__init__()
        self.stem = convolution(inputs, settings.stem_width, settings.stem_kernel, settings.stem_stride)
        self.pool = nn.MaxPool2d(3, stride=2, padding=1)
        stages, width = [], settings.stem_width
        for stage, (outputs, count) in enumerate(zip(settings.widths, settings.blocks, strict=True)):
            first = BasicBlock(width, outputs, stride=1 if stage == 0 else 2)
            stages.append(nn.Sequential(first, *(BasicBlock(outputs, outputs, 1) for _ in range(count - 1))))
            width = outputs
        self.stages = nn.ModuleList(stages)

    def forward(self, image: Tensor) -> list[Tensor]:
        """Features of the stem and of the stages, at strides s, 2s, 4s, 8s, 16s of the image, s the stem's."""
        levels = [self.stem(image)]
        x = self.pool(levels[0])
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        return levels
