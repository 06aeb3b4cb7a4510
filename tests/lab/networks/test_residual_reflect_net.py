from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from lab.networks.residual_reflect_net import ResidualReflectNet


def network() -> ResidualReflectNet:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return ResidualReflectNet()


def example(batch: int = 8, seed: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    """Images 10..30 m away, walls of 16 points about 5 m nearer."""
    generator = torch.Generator().manual_seed(seed)
    images = 10.0 + 20.0 * torch.rand(batch, 2, generator=generator)
    patch = images[:, None] - 5.0 + torch.randn(batch, 16, 2, generator=generator)
    state = torch.cat((images, torch.randn(batch, 4, generator=generator)), dim=1)
    return images, patch, state


def test_is_table_4() -> None:
    """Widths of Table 4 by the shapes of the published tensors; 120,706 parameters in all."""
    shapes = {name: tuple(p.shape) for name, p in network().named_parameters() if name.endswith("weight")}
    assert shapes == {
        "patch_encoder.0.weight": (64, 2),
        "patch_encoder.2.weight": (128, 64),
        "patch_encoder.4.weight": (128, 128),
        "query_encoder.0.weight": (64, 2),
        "query_encoder.2.weight": (128, 64),
        "state_encoder.0.weight": (64, 6),
        "state_encoder.2.weight": (64, 64),
        "decoder.0.weight": (256, 192),
        "decoder.2.weight": (128, 256),
        "decoder.4.weight": (2, 128),
    }
    assert sum(p.numel() for p in network().parameters()) == 120_706


def test_follows_equations_20_and_21() -> None:
    """Written out for one image, neighbour by neighbour, with the exponentials as printed."""
    net = network().double()
    images, patch, state = (x.double() for x in example(1))
    with torch.no_grad():
        query = net.query_encoder(images[0])
        points = [net.patch_encoder(neighbour - images[0]) for neighbour in patch[0]]
        weights = [torch.exp(query @ point) for point in points]
        feature = sum(weight * point for weight, point in zip(weights, points, strict=True)) / sum(weights)
        wanted = net.decoder(torch.cat((feature, net.state_encoder(state[0]))))
        torch.testing.assert_close(net(images, patch, state)[0], wanted, rtol=1e-10, atol=1e-12)


def test_order_of_the_neighbours_is_without_meaning() -> None:
    net = network()
    images, patch, state = example()
    with torch.no_grad():
        torch.testing.assert_close(net(images, patch.flip(1), state), net(images, patch, state), atol=1e-5, rtol=1e-4)


def test_patch_is_seen_from_the_image() -> None:
    """Only the query and the state know where the image is: with both held, patch and image may move together."""
    net = network().double()
    images, patch, state = (x.double() for x in example())
    with torch.no_grad():
        for parameter in net.query_encoder.parameters():
            parameter.zero_()
        shift = torch.tensor([3.0, -7.0], dtype=torch.float64)
        moved = net(images + shift, patch + shift, state)
        torch.testing.assert_close(moved, net(images, patch, state), rtol=1e-9, atol=1e-12)
        assert not torch.allclose(net(images, patch + shift, state), moved)


@pytest.mark.parametrize("scale", [1e3, 1e6])
def test_far_points_stay_finite(scale: float) -> None:
    """Scores grow with the square of the distance, to 1e10 and beyond: exp alone would leave float32 at 89."""
    net = network()
    images, patch, state = (scale * x for x in example())
    residual = net(images, patch, state)
    residual.sum().backward()
    assert torch.isfinite(residual).all()
    assert all(torch.isfinite(p.grad).all() for p in net.parameters() if p.grad is not None)


def test_gradients_reach_every_parameter() -> None:
    net = network()
    net(*example()).square().sum().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


@pytest.mark.slow
def test_learns_a_few_residuals() -> None:
    net = network()
    inputs, wanted = example(), torch.randn(8, 2)
    optimizer = torch.optim.Adam(net.parameters(), 1e-3)
    losses = []
    for _ in range(150):
        optimizer.zero_grad()
        loss = (net(*inputs) - wanted).abs().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.2 * losses[0]


def test_onnx_agrees(onnx_difference: Callable[..., float]) -> None:
    assert onnx_difference(network(), *example()) < 1e-5
