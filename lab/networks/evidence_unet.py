"""EvidenceUNet: hidden objects out of evidence in the bird's-eye view, 1 M parameters.

The blocks of `CompactUNet` on the cells of the plane say what surrounds a place; beside them the head reads the place's
own evidence once more.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from lab.networks.compact_unet import ResidualBlock, halved


@dataclass(frozen=True, kw_only=True)
class EvidenceUNetConfig:
    """Shape of an `EvidenceUNet`."""

    in_channels: int
    answers: int
    widths: tuple[int, ...] = (32, 64, 96, 128)
    stem_width: int = 48
    head_width: int = 64
    #: Initial logit of an object in every cell: a hundredth.
    head_bias: float = -4.6


class EvidenceUNet(nn.Module):
    """Evidence [batch, channels, x, y] to answers [batch, answers, x, y]; both sides multiples of 8."""

    def __init__(self, config: EvidenceUNetConfig) -> None:
        super().__init__()
        self.config = config
        widths, steps = config.widths, list(pairwise(config.widths))
        self.stem = nn.Sequential(
            *_of_each_cell(config.in_channels, config.stem_width), *_of_each_cell(config.stem_width, widths[0])
        )
        self.encode = nn.ModuleList(ResidualBlock(width) for width in widths)
        self.down = nn.ModuleList(halved(fine, coarse) for fine, coarse in steps)
        self.up = nn.ModuleList(nn.ConvTranspose2d(coarse, fine, 2, stride=2) for fine, coarse in reversed(steps))
        self.decode = nn.ModuleList(ResidualBlock(width) for width in reversed(widths[:-1]))
        last = nn.Conv2d(config.head_width, config.answers, 1)
        self.head = nn.Sequential(*_of_each_cell(widths[0] + config.in_channels, config.head_width), last)
        nn.init.normal_(last.weight, std=0.01)
        nn.init.zeros_(last.bias)
        with torch.no_grad():
            last.bias[0] = config.head_bias

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
