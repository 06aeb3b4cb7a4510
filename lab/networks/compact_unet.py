"""CompactUNet: dense LOS / mirrored prediction for a CPU, 0.96 M parameters.

A U-Net on folded range pairs. The class of a return depends on the whole scene (the wall in front of it, and that
wall's orientation), so the bottleneck attends globally. The head upsamples azimuth eightfold by pixel shuffle: no
convolution runs on an input that was only interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional


@dataclass(frozen=True, kw_only=True)
class CompactUNetConfig:
    """Shape of a `CompactUNet`; defaults fit `models.perception.find.encoding`."""

    in_channels: int = 5
    range_bins: int = 320
    columns: int = 32
    #: Output azimuths per input column.
    azimuth_factor: int = 8
    classes: int = 2
    #: Channels at each resolution; each step halves range and azimuth.
    widths: tuple[int, ...] = (24, 48, 96, 128)
    attention_blocks: int = 2
    attention_heads: int = 4
    #: Initial logit of every cell: sigmoid(-2.19) = 0.1, for sparse targets.
    head_bias: float = -2.19

    def __post_init__(self) -> None:
        step = 2 ** (len(self.widths) - 1)
        if self.range_bins % (2 * step) or self.columns % step:
            raise ValueError(
                f"range_bins must be a multiple of {2 * step} and columns of {step}, "
                f"got {self.range_bins} and {self.columns}"
            )
        if self.widths[-1] % self.attention_heads:
            raise ValueError(f"widths[-1] must be a multiple of attention_heads, got {self.widths[-1]}")

    @property
    def output_shape(self) -> tuple[int, int, int]:
        """(classes, range, azimuth) of one answer."""
        return self.classes, self.range_bins, self.columns * self.azimuth_factor

    @property
    def bottleneck_shape(self) -> tuple[int, int]:
        """(range, azimuth) cells at the bottom."""
        step = 2 ** (len(self.widths) - 1)
        return self.range_bins // (2 * step), self.columns // step


#: Four times the parameters, for accuracy.
WIDE = CompactUNetConfig(widths=(48, 96, 192, 256))
#: Columns enough for the 57-column array of the 77 GHz radar.
FINE = CompactUNetConfig(columns=128, azimuth_factor=2)


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions around a shortcut."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.convolve = nn.Sequential(
            nn.Conv2d(width, width, 3, padding=1, bias=False),
            nn.BatchNorm2d(width),
            nn.ReLU(inplace=True),
            nn.Conv2d(width, width, 3, padding=1, bias=False),
            nn.BatchNorm2d(width),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Map [batch, width, range, azimuth] to the same."""
        return functional.relu(x + self.convolve(x))


class AttentionBlock(nn.Module):
    """Pre-norm transformer block over all cells."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm_attention = nn.LayerNorm(width)
        self.query_key_value = nn.Linear(width, 3 * width)
        self.project = nn.Linear(width, width)
        self.norm_mlp = nn.LayerNorm(width)
        self.mlp = nn.Sequential(nn.Linear(width, 2 * width), nn.ReLU(inplace=True), nn.Linear(2 * width, width))

    def forward(self, x: Tensor) -> Tensor:
        """Map [batch, cells, width] to the same."""
        x = x + self.project(self._attend(self.norm_attention(x)))
        return x + self.mlp(self.norm_mlp(x))

    def _attend(self, x: Tensor) -> Tensor:
        batch, cells, width = x.shape
        # [3, batch, heads, cells, width / heads]
        split = self.query_key_value(x).reshape(batch, cells, 3, self.heads, width // self.heads)
        query, key, value = split.permute(2, 0, 3, 1, 4).unbind(0)
        weights = torch.softmax(query @ key.transpose(-2, -1) * (width // self.heads) ** -0.5, dim=-1)
        # [batch, cells, width]
        return (weights @ value).transpose(1, 2).reshape(batch, cells, width)


class GlobalContext(nn.Module):
    """Transformer over the cells of the bottleneck, with a learned position each."""

    def __init__(self, config: CompactUNetConfig) -> None:
        super().__init__()
        rows, columns = config.bottleneck_shape
        width = config.widths[-1]
        self.position = nn.Parameter(0.02 * torch.randn(1, rows * columns, width))
        self.blocks = nn.Sequential(
            *(AttentionBlock(width, config.attention_heads) for _ in range(config.attention_blocks))
        )

    def forward(self, x: Tensor) -> Tensor:
        """Map [batch, width, range, azimuth] to the same."""
        # [batch, cells, width]
        tokens = x.flatten(2).transpose(1, 2) + self.position
        return self.blocks(tokens).transpose(1, 2).reshape(x.shape)


class CompactUNet(nn.Module):
    """Encoded maps [batch, channels, range, columns] to logits [batch, classes, range, columns * azimuth_factor]."""

    def __init__(self, config: CompactUNetConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or CompactUNetConfig()
        widths = config.widths
        steps = list(pairwise(widths))
        self.stem = nn.Sequential(
            nn.Conv2d(2 * config.in_channels, widths[0], 3, padding=1, bias=False),
            nn.BatchNorm2d(widths[0]),
            nn.ReLU(inplace=True),
        )
        self.encode = nn.ModuleList(ResidualBlock(width) for width in widths[:-1])
        self.down = nn.ModuleList(halved(fine, coarse) for fine, coarse in steps)
        self.context = GlobalContext(config)
        self.up = nn.ModuleList(nn.ConvTranspose2d(coarse, fine, 2, stride=2) for fine, coarse in reversed(steps))
        self.decode = nn.ModuleList(ResidualBlock(width) for width in reversed(widths[:-1]))
        self.head = nn.Conv2d(widths[0], 2 * config.classes * config.azimuth_factor, 3, padding=1)
        nn.init.normal_(self.head.weight, std=0.01)
        nn.init.constant_(self.head.bias, config.head_bias)

    def forward(self, x: Tensor) -> Tensor:
        """Return logits of every cell of the output grid."""
        x = self.stem(_fold_range(x))
        skips = []
        for encode, down in zip(self.encode, self.down, strict=True):
            x = encode(x)
            skips.append(x)
            x = down(x)
        x = self.context(x)
        for up, decode in zip(self.up, self.decode, strict=True):
            x = decode(up(x) + skips.pop())
        return _shuffle(self.head(x), self.config.classes, self.config.azimuth_factor)


def halved(fine: int, coarse: int) -> nn.Sequential:
    """Return a convolution that halves range and azimuth."""
    return nn.Sequential(
        nn.Conv2d(fine, coarse, 3, stride=2, padding=1, bias=False), nn.BatchNorm2d(coarse), nn.ReLU(inplace=True)
    )


def _fold_range(x: Tensor) -> Tensor:
    """Map [batch, channels, range, columns] to [batch, 2 * channels, range / 2, columns]: bins in pairs."""
    batch, channels, rows, columns = x.shape
    pairs = x.reshape(batch, channels, rows // 2, 2, columns).transpose(2, 3)
    return pairs.reshape(batch, 2 * channels, rows // 2, columns)


def _shuffle(x: Tensor, classes: int, factor: int) -> Tensor:
    """Map [batch, classes * 2 * factor, rows, columns] to [batch, classes, 2 * rows, factor * columns]."""
    batch, _, rows, columns = x.shape
    # [batch, classes, rows, 2, columns, factor]
    cells = x.reshape(batch, classes, 2, factor, rows, columns).permute(0, 1, 4, 2, 5, 3)
    return cells.reshape(batch, classes, 2 * rows, factor * columns)
