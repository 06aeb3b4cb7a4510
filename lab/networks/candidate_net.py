"""CandidateNet: correction of how likely the evidence network calls a candidate an object, 0.1 M parameters.

Convolutions of the evidence about its place, read in the mean and in its middle, beside the facts.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

WIDTH, HIDDEN = 64, 96
DROPOUT = 0.2


class CandidateNet(nn.Module):
    """Places [N, channels, x, y] and facts [N, facts] to corrections of logits [N], none before training."""

    def __init__(self, channels: int, facts: int) -> None:
        super().__init__()
        self.about = nn.Sequential(*_layer(channels, 1), *_layer(WIDTH, 3), *_layer(WIDTH, 3, stride=2))
        self.scale = nn.BatchNorm1d(facts)
        last = nn.Linear(WIDTH, 1)
        self.head = nn.Sequential(
            nn.Linear(2 * WIDTH + facts, HIDDEN),
            nn.ReLU(inplace=True),
            nn.Dropout(DROPOUT),
            nn.Linear(HIDDEN, WIDTH),
            nn.ReLU(inplace=True),
            last,
        )
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, places: Tensor, facts: Tensor) -> Tensor:
        """Return the corrections of candidates."""
        about = self.about(places)
        middle = about[:, :, about.shape[2] // 2, about.shape[3] // 2]
        return self.head(torch.cat([about.mean(dim=(2, 3)), middle, self.scale(facts)], dim=1))[:, 0]


def _layer(channels: int, size: int, stride: int = 1) -> list[nn.Module]:
    convolution = nn.Conv2d(channels, WIDTH, size, stride, size // 2, bias=False)
    return [convolution, nn.BatchNorm2d(WIDTH), nn.ReLU(inplace=True)]
