"""ObjectUNet: hidden objects from a map and the hypotheses of its cells (`models.perception.objects`).

The blocks of `CompactUNet` on cells of two range bins say what surrounds a cell; beside it, the head reads the cell's
own hypotheses once more. Every cell answers for each of its hypotheses: does an object
have its image here, of which class, where within the image, how sure of it, how large and how turned.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from models.networks.compact_unet import AttentionBlock, ResidualBlock, halved


@dataclass(frozen=True, kw_only=True)
class ObjectUNetConfig:
    """Shape of an `ObjectUNet`."""

    in_channels: int
    rows: int
    columns: int
    #: Hypotheses of a cell, and answers for each.
    hypotheses: int
    answers: int
    widths: tuple[int, ...] = (32, 64, 128, 192)
    head_width: int = 96
    attention_blocks: int = 2
    attention_heads: int = 4
    #: Initial logit of an object in every cell: a hundredth.
    head_bias: float = -4.6

    def __post_init__(self) -> None:
        step = 2 ** (len(self.widths) - 1)
        if self.rows % step or self.columns % step:
            raise ValueError(f"rows and columns must be multiples of {step}, got {self.rows} and {self.columns}")
        if self.widths[-1] % self.attention_heads:
            raise ValueError(f"widths[-1] must be a multiple of attention_heads, got {self.widths[-1]}")


class ObjectUNet(nn.Module):
    """Encoded cells [batch, channels, rows, columns] to answers [batch, hypotheses * answers, rows, columns]."""

    def __init__(self, config: ObjectUNetConfig) -> None:
        super().__init__()
        self.config = config
        widths, steps = config.widths, list(pairwise(config.widths))
        self.stem = _of_each_cell(config.in_channels, widths[0])
        self.encode = nn.ModuleList(ResidualBlock(width) for width in widths[:-1])
        self.down = nn.ModuleList(halved(fine, coarse) for fine, coarse in steps)
        cells = config.rows * config.columns // 4 ** len(steps)
        self.position = nn.Parameter(0.02 * torch.randn(1, cells, widths[-1]))
        self.context = nn.Sequential(
            *(AttentionBlock(widths[-1], config.attention_heads) for _ in range(config.attention_blocks))
        )
        self.up = nn.ModuleList(nn.ConvTranspose2d(coarse, fine, 2, stride=2) for fine, coarse in reversed(steps))
        self.decode = nn.ModuleList(ResidualBlock(width) for width in reversed(widths[:-1]))
        last = nn.Conv2d(config.head_width, config.hypotheses * config.answers, 1)
        self.head = nn.Sequential(_of_each_cell(widths[0] + config.in_channels, config.head_width), last)
        nn.init.normal_(last.weight, std=0.01)
        nn.init.zeros_(last.bias)
        with torch.no_grad():
            last.bias[:: config.answers] = config.head_bias

    def forward(self, x: Tensor) -> Tensor:
        """Return the answers of every cell for each of its hypotheses."""
        cells = x
        x = self.stem(x)
        skips = []
        for encode, down in zip(self.encode, self.down, strict=True):
            x = encode(x)
            skips.append(x)
            x = down(x)
        x = self.context(x.flatten(2).transpose(1, 2) + self.position).transpose(1, 2).reshape(x.shape)
        for up, decode in zip(self.up, self.decode, strict=True):
            x = decode(up(x) + skips.pop())
        return self.head(torch.cat([x, cells.to(x.dtype)], dim=1))


def _of_each_cell(channels: int, width: int) -> nn.Sequential:
    """Return a layer of each cell alone: a cell's hypotheses say little about those of its neighbours."""
    return nn.Sequential(nn.Conv2d(channels, width, 1, bias=False), nn.BatchNorm2d(width), nn.ReLU(inplace=True))
