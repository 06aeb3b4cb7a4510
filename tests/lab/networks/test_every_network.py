"""What every network of a map owes: its shapes, gradients everywhere, maps of a batch apart, an export that agrees."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import nn

from lab.networks.compact_unet import CompactUNetConfig
from lab.networks.further_than_cfar import FurtherThanCfarConfig
from lab.networks.radar_tensor_network import RadarTensorNetworkConfig
from lab.networks.swin_unet import SwinUNetConfig
from lab.networks.unet import UNetConfig
from lab.training.map_networks import FAMILIES

#: Family and a configuration of few cells.
TINY: dict[str, Any] = {
    "compact_unet": CompactUNetConfig(range_bins=32, columns=8, widths=(8, 12, 16), attention_heads=2),
    "unet": UNetConfig(range_bins=16, columns=8, widths=(4, 6, 8)),
    "unet of squares": UNetConfig(range_bins=16, columns=8, widths=(4, 6, 8), patch=2),
    "further_than_cfar": FurtherThanCfarConfig(
        range_bins=64, columns=32, widths=(4, 4, 8, 8), blocks=(1, 1, 1, 1), pyramid_width=8, segmentation_width=8
    ),
    "radar_tensor_network": RadarTensorNetworkConfig(
        range_bins=32, columns=16, anchor_stride=2, widths=(4, 6, 8), blocks=(1, 1, 1), neck_width=6
    ),
    "radar_tensor_network of cells": RadarTensorNetworkConfig(
        range_bins=32, columns=16, anchor_stride=1, widths=(4, 6, 8), blocks=(1, 1, 1), neck_width=6
    ),
    "swin_unet": SwinUNetConfig(
        range_bins=64, columns=64, crop_columns=16, embed=8, depths=(2, 2, 2, 1), heads=(1, 2, 4, 8), window=(4, 4)
    ),
}


def network(name: str, **changes: Any) -> nn.Module:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return FAMILIES[name.split()[0]].module(replace(TINY[name], **changes))


def maps(name: str, count: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    config = TINY[name]
    return torch.randn(count, config.in_channels, config.range_bins, config.columns, dtype=dtype)


@pytest.mark.parametrize("name", FAMILIES)
def test_compact_ones_are_as_large_as_ours(name: str) -> None:
    """CompactUNet has 0.96 M parameters."""
    family = FAMILIES[name]
    with torch.device("meta"):
        assert 0.7e6 < sum(p.numel() for p in family.module(family.sizes["compact"]).parameters()) < 1.2e6


@pytest.mark.slow
@pytest.mark.parametrize(("name", "size"), [(name, size) for name in FAMILIES for size in FAMILIES[name].sizes])
def test_answers_every_cell(name: str, size: str) -> None:
    config = FAMILIES[name].sizes[size]
    with torch.device("meta"):
        answer = FAMILIES[name].module(config)(torch.empty(2, config.in_channels, config.range_bins, config.columns))
    assert answer.shape == (2, *config.output_shape)
    if name != "radar_tensor_network":
        assert config.output_shape == (2, config.range_bins, 256)


@pytest.mark.parametrize("name", TINY)
def test_maps_of_a_batch_do_not_mix(name: str) -> None:
    net, x = network(name).eval(), maps(name, 3)
    with torch.no_grad():
        torch.testing.assert_close(net(x)[1:2], net(x[1:2]), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", TINY)
def test_gradients_reach_every_parameter(name: str) -> None:
    net = network(name, **({"drop_path": 0.0} if name == "swin_unet" else {}))
    net(maps(name, 2)).square().sum().backward()
    for parameter_name, parameter in net.named_parameters():
        assert parameter.grad is not None, parameter_name
        assert parameter.grad.abs().sum() > 0, parameter_name


@pytest.mark.parametrize("name", ["compact_unet", "swin_unet"])
def test_every_input_cell_reaches_every_output(name: str) -> None:
    """The class of a return depends on the whole scene: no input cell may be without influence on a far output."""
    net = network(name, **({"crop_columns": 0} if name == "swin_unet" else {})).double().eval()
    x = maps(name, 1, torch.float64).requires_grad_()
    net(x)[0, 1, -1, -1].backward()
    assert x.grad is not None
    assert (x.grad.abs().sum(dim=1) > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", TINY)
def test_onnx_agrees(name: str, onnx_difference: Callable[..., float]) -> None:
    assert onnx_difference(network(name), maps(name, 1)) < 1e-5


@pytest.mark.parametrize(
    ("config", "change", "message"),
    [
        (CompactUNetConfig, {"range_bins": 324}, "range_bins must be a multiple of 16"),
        (CompactUNetConfig, {"columns": 30}, "columns of 8"),
        (CompactUNetConfig, {"attention_heads": 3}, r"widths\[-1\] must be a multiple of attention_heads, got 128"),
        (UNetConfig, {"range_bins": 500}, "multiples of 16, got 500 and 256"),
        (UNetConfig, {"columns": 24}, "multiples of 16, got 512 and 24"),
        (UNetConfig, {"range_bins": 336, "patch": 2}, "multiples of 32, got 336 and 256"),
        (FurtherThanCfarConfig, {"range_bins": 500}, "multiples of 32, got 500 and 256"),
        (FurtherThanCfarConfig, {"columns": 48}, "multiples of 32, got 512 and 48"),
        (FurtherThanCfarConfig, {"segmentation_width": 30}, "segmentation_width must be a multiple of 4, got 30"),
        (RadarTensorNetworkConfig, {"range_bins": 500}, "multiples of 8, got 500 and 256"),
        (RadarTensorNetworkConfig, {"columns": 248, "anchor_stride": 2}, "multiples of 16, got 512 and 248"),
        (RadarTensorNetworkConfig, {"blocks": (2, 2)}, r"one number a stage \(4\), got \(2, 2\)"),
        (RadarTensorNetworkConfig, {"anchor_stride": 0}, "anchor_stride must be at least 1, got 0"),
        (SwinUNetConfig, {"range_bins": 500}, "multiple of 32 and columns of 32, got 500 and 512"),
        (SwinUNetConfig, {"crop_columns": 130}, "crop_columns must be a multiple of 4 below 256, got 130"),
        (SwinUNetConfig, {"crop_columns": 256}, "crop_columns must be a multiple of 4 below 256, got 256"),
        (SwinUNetConfig, {"drop_path": 1.0}, r"drop_path must be in \[0, 1\), got 1.0"),
        (SwinUNetConfig, {"depths": (2, 2, 2)}, "depths must be 4 counts of at least 1"),
        (SwinUNetConfig, {"heads": (3, 6, 12, 25)}, r"heads must divide the widths \[96, 192, 384, 768\]"),
        (SwinUNetConfig, {"range_bins": 352}, "window must tile the 22 cells of stage 2 by at least half, got 8"),
    ],
)
def test_shapes_that_do_not_fit_are_refused(config: Any, change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        config(**change)
