"""ResidualReflectNet: residual of the mirror law of a fitted wall, Table 4, 120,706 parameters."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn


class ResidualReflectNet(nn.Module):
    """Images with their patch of LOS points and their wall to the correction of the mirror law, Eqs. (20)-(21)."""

    def __init__(self) -> None:
        super().__init__()
        self.patch_encoder = _perceptron(2, 64, 128, 128)
        self.query_encoder = _perceptron(2, 64, 128)
        self.state_encoder = _perceptron(6, 64, 64)
        self.decoder = _perceptron(192, 256, 128, 2)

    def forward(self, images: Tensor, patch: Tensor, state: Tensor) -> Tensor:
        """Return residuals [batch, 2] in metres; images [batch, 2], patches [batch, neighbours, 2], states [batch, 6].

        Images and patch are in metres in the radar frame. A state is the image, the wall's normal and offset_m, and 1
        where the image had no wall of its own, else 0.
        """
        # [batch, neighbours, 128]
        points = self.patch_encoder(patch - images[:, None])
        query = self.query_encoder(images)
        # Eq. (20); softmax subtracts the largest score, so it never overflows. [batch, neighbours, 1]
        attention = torch.softmax(points @ query[:, :, None], dim=1)
        # [batch, 128]
        patch_feature = (attention * points).sum(dim=1)
        return self.decoder(torch.cat((patch_feature, self.state_encoder(state)), dim=1))


def _perceptron(*widths: int) -> nn.Sequential:
    """Return linear layers with a ReLU between."""
    layers: list[nn.Module] = []
    for into, out in pairwise(widths):
        layers += [nn.Linear(into, out), nn.ReLU()]
    return nn.Sequential(*layers[:-1])
