"""UNet: the convolutional baseline of Table 5, 31 M parameters at its published widths.

Two 3x3 convolutions a resolution, each with batch normalisation; max-pooling down, transposed convolution up, and the
encoder's features concatenated in the decoder. With `patch` 2 it works on squares of 2 x 2 cells side by side as
channels, at a quarter of the cost: full resolution is too expensive on a CPU.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional


@dataclass(frozen=True, kw_only=True)
class UNetConfig:
    """Shape of a `UNet`; the defaults are the published widths on the whole map."""

    in_channels: int = 3
    range_bins: int = 512
    columns: int = 256
    classes: int = 2
    #: Cells on a side that are folded into channels; 1 is the published network.
    patch: int = 1
    #: Channels at each resolution; each step halves range and azimuth.
    widths: tuple[int, ...] = (64, 128, 256, 512, 1024)
    #: Initial logit of every cell: sigmoid(-2.19) = 0.1, for sparse targets.
    head_bias: float = -2.19

    def __post_init__(self) -> None:
        step = self.patch * 2 ** (len(self.widths) - 1)
        if self.range_bins % step or self.columns % step:
            raise ValueError(
                f"range_bins and columns must be multiples of {step}, got {self.range_bins} and {self.columns}"
            )

    @property
    def output_shape(self) -> tuple[int, int, int]:
        """(classes, range, azimuth) of one answer."""
        return self.classes, self.range_bins, self.columns


FULL = UNetConfig()
#: For a CPU.
COMPACT = UNetConfig(range_bins=320, patch=2, widths=(16, 24, 48, 96, 192))


class UNet(nn.Module):
    """Encoded maps [batch, channels, range, columns] to logits [batch, classes, range, columns]."""

    def __init__(self, config: UNetConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or UNetConfig()
        widths = config.widths
        steps = list(pairwise(widths))
        self.stem = _double_convolution(config.in_channels * config.patch**2, widths[0])
        self.down = nn.ModuleList(
            nn.Sequential(nn.MaxPool2d(2), _double_convolution(fine, coarse)) for fine, coarse in steps
        )
        self.up = nn.ModuleList(nn.ConvTranspose2d(coarse, fine, 2, stride=2) for fine, coarse in reversed(steps))
        self.decode = nn.ModuleList(_double_convolution(2 * fine, fine) for fine, _ in reversed(steps))
        self.head = nn.Conv2d(widths[0], config.classes * config.patch**2, 1)
        nn.init.constant_(self.head.bias, config.head_bias)

    def forward(self, x: Tensor) -> Tensor:
        """Return logits of every cell."""
        x = self.stem(functional.pixel_unshuffle(x, self.config.patch))
        skips = []
        for down in self.down:
            skips.append(x)
            x = down(x)
        for up, decode in zip(self.up, self.decode, strict=True):
            x = decode(torch.cat((skips.pop(), up(x)), dim=1))
        return functional.pixel_shuffle(self.head(x), self.config.patch)


def _double_convolution(in_width: int, out_width: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(in_width, out_width, 3, padding=1, bias=False),
        nn.BatchNorm2d(out_width),
        nn.ReLU(inplace=True),
        nn.Conv2d(out_width, out_width, 3, padding=1, bias=False),
        nn.BatchNorm2d(out_width),
        nn.ReLU(inplace=True),
    )
