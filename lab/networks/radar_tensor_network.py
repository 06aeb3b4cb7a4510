"""RadarTensorNetwork: RTN with the 2-D dense convolutional backbone (arXiv 2206.08171), adapted to points.

A residual network without early pooling; each of its stages is brought back to the first one's resolution, and two 1x1
heads read all of them together. Anchors are the cells of the map: three class logits (LOS, mirrored, noise) and the
offset (range, azimuth) in cells from the anchor to the point. `models.perception.find.anchors` reads the answer.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from lab.networks.resnet import residual_stage, stem


@dataclass(frozen=True, kw_only=True)
class RadarTensorNetworkConfig:
    """Shape of a `RadarTensorNetwork`; the defaults have an anchor on every cell of the whole map."""

    in_channels: int = 3
    range_bins: int = 512
    columns: int = 256
    #: Cells from anchor to anchor, on both axes.
    anchor_stride: int = 1
    #: Channels of the stages; each stage after the first halves range and azimuth.
    widths: tuple[int, ...] = (64, 128, 256, 512)
    blocks: tuple[int, ...] = (2, 2, 2, 2)
    #: Channels that each stage gives to the heads.
    neck_width: int = 128

    def __post_init__(self) -> None:
        if self.anchor_stride < 1:
            raise ValueError(f"anchor_stride must be at least 1, got {self.anchor_stride}")
        if len(self.blocks) != len(self.widths):
            raise ValueError(f"blocks must have one number a stage ({len(self.widths)}), got {self.blocks}")
        step = self.anchor_stride * 2 ** (len(self.widths) - 1)
        if self.range_bins % step or self.columns % step:
            raise ValueError(
                f"range_bins and columns must be multiples of {step}, got {self.range_bins} and {self.columns}"
            )

    @property
    def output_shape(self) -> tuple[int, int, int]:
        """(class logits and offsets, rows, columns) of one answer."""
        return 5, self.range_bins // self.anchor_stride, self.columns // self.anchor_stride


FULL = RadarTensorNetworkConfig()
#: An anchor on every second cell, for a CPU.
COMPACT = RadarTensorNetworkConfig(
    range_bins=320, anchor_stride=2, widths=(16, 32, 64, 128), blocks=(1, 1, 2, 2), neck_width=32
)


class RadarTensorNetwork(nn.Module):
    """Encoded maps [batch, channels, range, columns] to [batch, 5, range / stride, columns / stride].

    Channels 0..2 are the logits of LOS, mirrored and noise; 3 and 4 the offset in cells of the map.
    """

    def __init__(self, config: RadarTensorNetworkConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or RadarTensorNetworkConfig()
        widths = config.widths
        into = (widths[0], *widths[:-1])
        strides = [1] + [2] * (len(widths) - 1)
        self.stem = stem(config.in_channels, widths[0], config.anchor_stride)
        self.stages = nn.ModuleList(
            residual_stage(*shape) for shape in zip(into, widths, config.blocks, strides, strict=True)
        )
        self.neck = nn.ModuleList(_upsample(width, config.neck_width, 2**level) for level, width in enumerate(widths))
        self.classify = nn.Conv2d(len(widths) * config.neck_width, 3, 1)
        self.locate = nn.Conv2d(len(widths) * config.neck_width, 2, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return class logits and offsets of every anchor."""
        x = self.stem(x)
        necks = []
        for stage, neck in zip(self.stages, self.neck, strict=True):
            x = stage(x)
            necks.append(neck(x))
        # [batch, stages * neck_width, rows, columns]
        features = torch.cat(necks, dim=1)
        return torch.cat((self.classify(features), self.locate(features)), dim=1)


def _upsample(in_width: int, out_width: int, factor: int) -> nn.Sequential:
    """Return a transposed convolution whose kernel covers each fine cell once."""
    return nn.Sequential(
        nn.ConvTranspose2d(in_width, out_width, factor, stride=factor, bias=False),
        nn.BatchNorm2d(out_width),
        nn.ReLU(inplace=True),
    )
