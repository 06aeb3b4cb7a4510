from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from lab.networks.radar_tensor_network import COMPACT, FULL, RadarTensorNetwork, RadarTensorNetworkConfig
from lab.training.data.samples import PointLabels
from lab.training.objectives.anchors import anchor_loss, anchor_targets
from models.perception.find.anchors import anchor_points

TINY = RadarTensorNetworkConfig(
    range_bins=32, columns=16, anchor_stride=2, widths=(4, 6, 8), blocks=(1, 1, 1), neck_width=6
)


def network(config: RadarTensorNetworkConfig = TINY) -> RadarTensorNetwork:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return RadarTensorNetwork(config)


@pytest.mark.parametrize("config", [FULL, COMPACT, replace(COMPACT, anchor_stride=4), replace(TINY, anchor_stride=1)])
def test_answers_every_anchor(config: RadarTensorNetworkConfig) -> None:
    stride = config.anchor_stride
    with torch.device("meta"):
        output = RadarTensorNetwork(config)(torch.empty(2, 3, config.range_bins, config.columns))
    assert output.shape == (2, *config.output_shape) == (2, 5, config.range_bins // stride, config.columns // stride)


def test_no_pooling_before_the_stages() -> None:
    """The first stage works at the anchors' own resolution: that of the map, with an anchor on every cell."""
    net = network(replace(TINY, anchor_stride=1))
    assert net.stages[0](net.stem(torch.zeros(1, 3, 32, 16))).shape == (1, 4, 32, 16)


@pytest.mark.slow
def test_learns_one_map() -> None:
    """One map with a point a class: the loss falls below a tenth, and both points come back within half a cell."""
    net = network()
    x = torch.randn(1, 3, 32, 16)
    points = PointLabels(row=np.array([9.3, 21.8]), column=np.array([4.6, 11.1]), path_class=np.array([0, 1], np.uint8))
    classes, offsets = (torch.from_numpy(at) for at in anchor_targets([points], TINY.output_shape[1:], stride=2))
    optimizer = torch.optim.Adam(net.parameters(), 2e-2)
    losses = []
    for _ in range(120):
        optimizer.zero_grad()
        loss = anchor_loss(net(x), classes, offsets)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.1 * losses[0]
    with torch.no_grad():
        found = anchor_points(net(x)[0].numpy(), stride=2, threshold=0.5, min_distance=3)
        cells, path_class = found.cells, found.path_class
    assert path_class.tolist() == [0, 1]
    np.testing.assert_allclose(cells, [[9.3, 4.6], [21.8, 11.1]], atol=0.5)
