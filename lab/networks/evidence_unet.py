"""EvidenceUNet: hidden objects out of evidence in the bird's-eye view, 1 M parameters.

The blocks of `CompactUNet` on the cells of the plane say what surrounds a place; beside them the head reads the place's
own evidence once more.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from lab.networks.compact_unet import ResidualBlock, halved

#: Channels at each resolution; each step halves both sides.
WIDTHS = (32, 64, 96, 128)
STEM_WIDTH, HEAD_WIDTH = 48, 64
#: Initial logit of an object in every cell: a hundredth.
HEAD_BIAS = -4.6


class EvidenceUNet(nn.Module):
    """Evidence [batch, channels, x, y] to answers [batch, answers, x, y]; both sides multiples of 8."""

    def __init__(self, in_channels: int, answers: int) -> None:
        super().__init__()
        steps = list(pairwise(WIDTHS))
        self.stem = nn.Sequential(*_of_each_cell(in_channels, STEM_WIDTH), *_of_each_cell(STEM_WIDTH, WIDTHS[0]))
        self.encode = nn.ModuleList(ResidualBlock(width) for width in WIDTHS)
        self.down = nn.ModuleList(halved(fine, coarse) for fine, coarse in steps)
        self.up = nn.ModuleList(nn.ConvTranspose2d(coarse, fine, 2, stride=2) for fine, coarse in reversed(steps))
        self.decode = nn.ModuleList(ResidualBlock(width) for width in reversed(WIDTHS[:-1]))
        last = nn.Conv2d(HEAD_WIDTH, answers, 1)
        self.head = nn.Sequential(*_of_each_cell(WIDTHS[0] + in_channels, HEAD_WIDTH), last)
        nn.init.normal_(last.weight, std=0.01)
        nn.init.zeros_(last.bias)
        with torch.no_grad():
            last.bias[0] = HEAD_BIAS

    def forward(self, x: Tensor) -> Tensor:
        """Return the answers of every place."""
        evidence = x
        x = self.stem(x)
        skips = []
        for encode, down in zip(self.encode[:-1], self.down, strict=True):
            x = encode(x)
            skips.append(x)
            x = down(x)
        x = self.encode[-1](x)
        for up, decode in zip(self.up, self.decode, strict=True):
            x = decode(up(x) + skips.pop())
        return self.head(torch.cat([x, evidence.to(x.dtype)], dim=1))


def _of_each_cell(channels: int, width: int) -> list[nn.Module]:
    """Return a layer of each cell alone."""
    return [nn.Conv2d(channels, width, 1, bias=False), nn.BatchNorm2d(width), nn.ReLU(inplace=True)]
