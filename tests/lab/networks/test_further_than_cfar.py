from __future__ import annotations

import torch

from lab.networks.further_than_cfar import FULL, FurtherThanCfar, FurtherThanCfarConfig

TINY = FurtherThanCfarConfig(
    range_bins=64, columns=32, widths=(4, 4, 8, 8), blocks=(1, 1, 1, 1), pyramid_width=8, segmentation_width=8
)


def network(config: FurtherThanCfarConfig = TINY) -> FurtherThanCfar:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return FurtherThanCfar(config)


def test_published_widths_have_their_counts() -> None:
    """A ResNet-18 without its classifier has 11,176,512 parameters at 3 channels.

    By hand, the rest. Lateral convolutions: 256 * (64 + 128 + 256 + 512) + 4 * 256. Segmentation: one convolution from
    256 to 128 at each of the four levels, and 0 + 0 + 1 + 2 from 128 to 128; each with a scale and a shift of 128.
    Head: 2 * 128 + 2.
    """
    with torch.device("meta"):
        net = FurtherThanCfar(FULL)
    lateral = 256 * (64 + 128 + 256 + 512) + 4 * 256
    segmentation = 4 * (9 * 256 * 128 + 256) + 3 * (9 * 128 * 128 + 256)
    assert sum(p.numel() for p in net.backbone.parameters()) == 11_176_512
    assert sum(p.numel() for p in net.parameters()) == 11_176_512 + lateral + segmentation + 2 * 128 + 2


def test_features_halve_from_stage_to_stage() -> None:
    shapes = [tuple(x.shape[1:]) for x in network().backbone(torch.zeros(1, 3, 64, 32))]
    assert shapes == [(4, 16, 8), (4, 8, 4), (8, 4, 2), (8, 2, 1)]


def test_dropout_acts_in_training_only() -> None:
    net = network()
    x = torch.randn(1, 3, 64, 32)
    with torch.no_grad():
        assert not torch.equal(net(x), net(x))
        net.eval()
        assert torch.equal(net(x), net(x))
