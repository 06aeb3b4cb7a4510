"""Residual blocks and stages of a ResNet, shared by the two baselines built on one."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional


class BasicBlock(nn.Module):
    """Two 3x3 convolutions around a shortcut; the first one may stride and widen, then the shortcut is projected."""

    def __init__(self, in_width: int, out_width: int, stride: int = 1) -> None:
        super().__init__()
        self.convolve = nn.Sequential(
            nn.Conv2d(in_width, out_width, 3, stride=stride, padding=1, bias=False),
            nn.BatchNorm2d(out_width),
            nn.ReLU(inplace=True),
            nn.Conv2d(out_width, out_width, 3, padding=1, bias=False),
            nn.BatchNorm2d(out_width),
        )
        self.shortcut: nn.Module = nn.Identity()
        if stride != 1 or in_width != out_width:
            self.shortcut = nn.Sequential(
                nn.Conv2d(in_width, out_width, 1, stride=stride, bias=False), nn.BatchNorm2d(out_width)
            )

    def forward(self, x: Tensor) -> Tensor:
        """Map [batch, in_width, rows, columns] to [batch, out_width, rows / stride, columns / stride]."""
        return functional.relu(self.shortcut(x) + self.convolve(x))


def residual_stage(in_width: int, out_width: int, blocks: int, stride: int) -> nn.Sequential:
    """Return `blocks` residual blocks, of which the first strides."""
    rest = (BasicBlock(out_width, out_width) for _ in range(blocks - 1))
    return nn.Sequential(BasicBlock(in_width, out_width, stride), *rest)


def stem(in_channels: int, width: int, stride: int) -> nn.Sequential:
    """Return the 7x7 convolution in front of the stages."""
    return nn.Sequential(
        nn.Conv2d(in_channels, width, 7, stride=stride, padding=3, bias=False),
        nn.BatchNorm2d(width),
        nn.ReLU(inplace=True),
    )
