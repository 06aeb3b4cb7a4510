"""Further than CFAR: feature pyramid segmentation on a ResNet-18 (arXiv 2402.12970), 13 M parameters.

Its variant without Doppler, with our channels in and one logit each for LOS and mirrored returns out. It works
at a quarter of the resolution and interpolates to the map.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn
from torch.nn import functional

from lab.networks.resnet import residual_stage, stem

#: Cells of the coarsest stage on a side.
_COARSEST = 32


@dataclass(frozen=True, kw_only=True)
class FurtherThanCfarConfig:
    """Shape of a `FurtherThanCfar`; the defaults are the published widths on the whole map."""

    in_channels: int = 3
    range_bins: int = 512
    columns: int = 256
    classes: int = 2
    #: Channels of the four stages of the backbone, at 1/4, 1/8, 1/16 and 1/32 of the resolution.
    widths: tuple[int, int, int, int] = (64, 128, 256, 512)
    blocks: tuple[int, int, int, int] = (2, 2, 2, 2)
    pyramid_width: int = 256
    #: A multiple of four: features are normalised in groups of four channels.
    segmentation_width: int = 128
    dropout: float = 0.2

    def __post_init__(self) -> None:
        if self.range_bins % _COARSEST or self.columns % _COARSEST:
            raise ValueError(
                f"range_bins and columns must be multiples of {_COARSEST}, got {self.range_bins} and {self.columns}"
            )
        if self.segmentation_width % 4:
            raise ValueError(f"segmentation_width must be a multiple of 4, got {self.segmentation_width}")

    @property
    def output_shape(self) -> tuple[int, int, int]:
        """(classes, range, azimuth) of one answer."""
        return self.classes, self.range_bins, self.columns


FULL = FurtherThanCfarConfig()
#: A quarter of every width, for a CPU.
COMPACT = FurtherThanCfarConfig(range_bins=320, widths=(16, 32, 64, 128), pyramid_width=64, segmentation_width=32)


class ResNet(nn.Module):
    """Backbone: the features of its four stages, finest first."""

    def __init__(self, config: FurtherThanCfarConfig) -> None:
        super().__init__()
        widths = config.widths
        self.stem = nn.Sequential(stem(config.in_channels, widths[0], stride=2), nn.MaxPool2d(3, stride=2, padding=1))
        into = (widths[0], *widths[:-1])
        self.stages = nn.ModuleList(
            residual_stage(*shape) for shape in zip(into, widths, config.blocks, (1, 2, 2, 2), strict=True)
        )

    def forward(self, x: Tensor) -> list[Tensor]:
        """Map [batch, channels, range, columns] to four of [batch, width, range / step, columns / step]."""
        x = self.stem(x)
        features = []
        for stage in self.stages:
            x = stage(x)
            features.append(x)
        return features


class FurtherThanCfar(nn.Module):
    """Encoded maps [batch, channels, range, columns] to logits [batch, classes, range, columns]."""

    def __init__(self, config: FurtherThanCfarConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or FurtherThanCfarConfig()
        self.backbone = ResNet(config)
        self.lateral = nn.ModuleList(nn.Conv2d(width, config.pyramid_width, 1) for width in config.widths)
        self.segment = nn.ModuleList(
            _segmentation(config.pyramid_width, config.segmentation_width, level) for level in range(len(config.widths))
        )
        self.dropout = nn.Dropout2d(config.dropout)
        self.head = nn.Conv2d(config.segmentation_width, config.classes, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return logits of every cell."""
        pyramid = self._pyramid(self.backbone(x))
        merged = sum(segment(level) for segment, level in zip(self.segment, pyramid, strict=True))
        return functional.interpolate(self.head(self.dropout(merged)), scale_factor=4.0, mode="bilinear")

    def _pyramid(self, features: list[Tensor]) -> list[Tensor]:
        """Return features of equal width, finest first; coarse features are added to fine ones."""
        levels = [lateral(feature) for lateral, feature in zip(self.lateral, features, strict=True)]
        for fine in reversed(range(len(levels) - 1)):
            levels[fine] = levels[fine] + functional.interpolate(levels[fine + 1], scale_factor=2.0, mode="nearest")
        return levels


def _segmentation(in_width: int, out_width: int, doublings: int) -> nn.Sequential:
    """Return one convolution at the finest level; below it, one and an upsampling by two for each level."""
    layers = _convolution(in_width, out_width)
    for step in range(doublings):
        layers += _convolution(out_width, out_width) if step else []
        layers.append(nn.Upsample(scale_factor=2.0, mode="bilinear"))
    return nn.Sequential(*layers)


def _convolution(in_width: int, out_width: int) -> list[nn.Module]:
    return [
        nn.Conv2d(in_width, out_width, 3, padding=1, bias=False),
        nn.GroupNorm(out_width // 4, out_width),
        nn.ReLU(inplace=True),
    ]
